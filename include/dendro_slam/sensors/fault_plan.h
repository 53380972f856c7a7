#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Geometry>

namespace dendro {

/// A fault that a sensor is given on purpose, to see what the pipeline makes of it.
struct FaultConfig {
  std::string fault = "";   ///< "drop", "delay", "jump" or "silence".
  double from_s = 0.0;      ///< Begin, in the script's time [s]. >= 0.
  double to_s = 1e9;        ///< End, in the script's time [s]. > from_s.
  double ratio = 0.0;       ///< drop: share of the messages (lidar: packets) lost, (0, 1].
  double delay_s = 0.0;     ///< delay: messages come later by this, their stamps stay [s]. > 0.
  double stamp_s = 0.0;     ///< jump: added to the stamps [s].
  double x_m = 0.0;         ///< jump: the odometry frame is displaced by this [m].
  double y_m = 0.0;         ///< jump: the odometry frame is displaced by this [m].
  double z_m = 0.0;         ///< jump: the odometry frame is displaced by this [m].
  double yaw_deg = 0.0;     ///< jump: and turned about its z axis [deg].

  /// @throws std::invalid_argument naming the field.
  void Validate() const;
  template <class Visitor>
  void Visit(Visitor&& v) {
    v("fault", fault);
    v("from_s", from_s);
    v("to_s", to_s);
    v("ratio", ratio);
    v("delay_s", delay_s);
    v("stamp_s", stamp_s);
    v("x_m", x_m);
    v("y_m", y_m);
    v("z_m", z_m);
    v("yaw_deg", yaw_deg);
  }
};

/// What the faults do to one message.
struct FaultVerdict {
  bool lost = false;               ///< It is not sent at all.
  std::int64_t delay_ns = 0;       ///< It is sent later by this [ns].
  std::int64_t stamp_shift_ns = 0; ///< Added to its stamps [ns].
  /// Pose of the old odometry frame in the new one: `T_odom' = T_jump * T_odom`, which leaves all
  /// motions before and after the jump as they are, as when a tracker finds itself again.
  Eigen::Isometry3d T_jump = Eigen::Isometry3d::Identity();
};

/// The faults of one sensor over the script's time. Whether a message is dropped follows from its
/// key and the seed alone, so that a repeated run loses the same ones.
class FaultPlan {
 public:
  FaultPlan() = default;
  /// @throws std::invalid_argument naming the fault and the field.
  FaultPlan(std::vector<FaultConfig> faults, int seed);

  /// @param script_s  When the message would be sent, in the script's time [s].
  /// @param key       Of the message; its stamp, say.
  FaultVerdict At(double script_s, std::uint64_t key) const;

  bool empty() const { return faults_.empty(); }

 private:
  std::vector<FaultConfig> faults_;
  std::uint64_t seed_ = 0;
};

}  // namespace dendro
