#pragma once

#include <memory>
#include <optional>
#include <string>

#include "dendro_slam/odometry/relative_motion.h"
#include "dendro_slam/range_image/range_image.h"

namespace dendro {

/// Settings of WoodIcp.
struct WoodIcpConfig {
  std::string points = "wood";   ///< Returns to register: "wood", or "all" for every return.
  int use_all_points_below_wood_count = 120;  ///< Register every return of a scan pair when either
                                              ///< scan has fewer wood returns than this. >= 0.
  double min_range_m = 0.4;      ///< Nearer returns are left out [m]. >= 0.
  double max_range_m = 40.0;     ///< Farther returns are left out [m]. > min_range_m.
  int min_points = 60;           ///< Fewer usable returns: no motion is reported. >= 10.
  int max_points = 900;          ///< Source returns kept, spread evenly over the scan. >= min_points.
  int max_target_points = 6000;  ///< Target returns kept. >= max_points.
  double neighbour_radius_m = 0.25;  ///< Reach of the neighbourhood that gives a return its surface [m]. > 0.
  int neighbour_rings = 2;       ///< Rings above and below that belong to the neighbourhood. >= 1.
  double max_correspondence_m = 0.6;  ///< Pairs farther apart are ignored at first [m]. > 0.
  double final_correspondence_m = 0.2;  ///< The same when the motion has settled [m]. > 0.
  double noise_sigma_m = 0.02;   ///< Floor of the residual's standard deviation [m]. > 0.
  double normal_sigma_rad = 0.06;  ///< Error of a return's surface normal [rad]. >= 0.
  double correlation_points = 4.0;  ///< Neighbouring returns whose errors act as one: the covariance grows
                                    ///< by it. >= 1.
  double sigma_floor_rad = 0.002;   ///< Added to the covariance of every motion, per axis [rad]. >= 0.
  double sigma_floor_m = 0.005;     ///< Added to the covariance of every motion, per axis [m]. >= 0.
  double degenerate_sigma_m = 0.5;  ///< Directions that the points tell less about than this keep the
                                    ///< guess and get this sigma [m, and rad per metre of reach]. > 0.
  int max_iterations = 25;       ///< Gauss-Newton iterations. > 0.
  double converged_rad = 1e-4;   ///< Step below which the motion has settled [rad]. > 0.
  double converged_m = 2e-4;     ///< Step below which the motion has settled [m]. > 0.
  double min_overlap = 0.35;     ///< Share of source returns that must find a partner. In (0, 1].

  /// @throws std::invalid_argument naming the field.
  void Validate() const;

  template <class Visitor>
  void Visit(Visitor&& v) {
    v("points", points);
    v("use_all_points_below_wood_count", use_all_points_below_wood_count);
    v("min_range_m", min_range_m);
    v("max_range_m", max_range_m);
    v("min_points", min_points);
    v("max_points", max_points);
    v("max_target_points", max_target_points);
    v("neighbour_radius_m", neighbour_radius_m);
    v("neighbour_rings", neighbour_rings);
    v("max_correspondence_m", max_correspondence_m);
    v("final_correspondence_m", final_correspondence_m);
    v("noise_sigma_m", noise_sigma_m);
    v("normal_sigma_rad", normal_sigma_rad);
    v("correlation_points", correlation_points);
    v("sigma_floor_rad", sigma_floor_rad);
    v("sigma_floor_m", sigma_floor_m);
    v("degenerate_sigma_m", degenerate_sigma_m);
    v("max_iterations", max_iterations);
    v("converged_rad", converged_rad);
    v("converged_m", converged_m);
    v("min_overlap", min_overlap);
  }
};

/// What became of the last scan given to WoodIcp.
enum class WoodIcpStatus : std::uint8_t {
  kConverged = 0,
  kFirstScan,      ///< Nothing to compare with yet.
  kTooFewPoints,   ///< This scan or the one before has too few usable returns.
  kNotConverged,   ///< The iterations ran out.
  kLowOverlap,     ///< Too few returns found a partner.
  kTimeNotAhead,   ///< The stamp is not later than the one before; the scan starts anew.
};

/// A phrase for people, e.g. "too few points".
const char* ToString(WoodIcpStatus status);

/// Odometry from consecutive scans: generalized ICP (Segal, Haehnel, Thrun 2009) on the wood returns.
///
/// The surface at a return comes from its neighbours in the range image (across rings, not from the
/// nearest points in space: at 5 m a VLP-16 has its rings ten times as far apart as its columns, and
/// nearest points would all lie on one ring). The covariance is that of the least-squares problem,
/// scaled by the residuals; along a lone trunk it is large, because nothing measures that direction.
/// Directions that the returns cannot tell keep the guess.
///
/// Owns the previous scan's returns with their surfaces and a k-d tree. One thread; a few
/// milliseconds per scan at the default sizes. Not thread-safe; instances are independent.
class WoodIcp {
 public:
  /// @throws std::invalid_argument for a bad configuration.
  explicit WoodIcp(WoodIcpConfig config = {});
  ~WoodIcp();
  WoodIcp(WoodIcp&&) noexcept;
  WoodIcp& operator=(WoodIcp&&) noexcept;

  /// Motion of the lidar from the previous scan to this one.
  /// @param scan             This scan, in the lidar frame at its stamp, free of its own motion.
  /// @param T_prev_cur_guess Pose of this scan's lidar frame in the previous one's, for instance from
  ///                         VIO. Without it the motion before is assumed to go on.
  /// @return  The motion, or nothing; status() says why. This scan is the next one's reference in
  ///          either case.
  std::optional<RelativeMotion> AddScan(const LabelledScan& scan,
                                        const std::optional<Eigen::Isometry3d>& T_prev_cur_guess);

  WoodIcpStatus status() const;
  int iterations() const;         ///< Of the last scan.
  int num_correspondences() const;  ///< Of the last scan.
  bool used_all_points() const;   ///< The last motion fell back on all returns.

  /// Forgets the previous scan.
  void Reset();

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace dendro
