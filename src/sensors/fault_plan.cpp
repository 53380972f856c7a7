#include "dendro_slam/sensors/fault_plan.h"

#include <cmath>
#include <stdexcept>
#include <utility>

namespace dendro {

namespace {

// Finaliser of SplitMix64 (Steele, Lea and Flood 2014): a bijection that mixes all bits.
std::uint64_t Mix(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

double Uniform(std::uint64_t seed, std::uint64_t key) {
  return static_cast<double>(Mix(seed ^ Mix(key)) >> 11) * 0x1.0p-53;
}

std::int64_t Ns(double s) { return static_cast<std::int64_t>(std::llround(s * 1e9)); }

}  // namespace

void FaultConfig::Validate() const {
  const auto require = [this](bool holds, const char* what) {
    if (!holds) throw std::invalid_argument("fault " + fault + ": " + what);
  };
  const bool jump = fault == "jump";
  if (fault != "drop" && fault != "delay" && !jump && fault != "silence") {
    throw std::invalid_argument("fault must be drop, delay, jump or silence, not '" + fault + "'");
  }
  require(from_s >= 0.0, "from_s must not be negative");
  require(to_s > from_s, "to_s must be later than from_s");
  require(fault == "drop" ? ratio > 0.0 && ratio <= 1.0 : ratio == 0.0,
          fault == "drop" ? "ratio must be in (0, 1]" : "ratio belongs to drop");
  require(fault == "delay" ? delay_s > 0.0 && delay_s <= 60.0 : delay_s == 0.0,
          fault == "delay" ? "delay_s must be in (0, 60]" : "delay_s belongs to delay");
  const bool moves =
      stamp_s != 0.0 || x_m != 0.0 || y_m != 0.0 || z_m != 0.0 || yaw_deg != 0.0;
  require(jump == moves,
          jump ? "give at least one of stamp_s, x_m, y_m, z_m, yaw_deg"
               : "stamp_s, x_m, y_m, z_m and yaw_deg belong to jump");
  require(std::abs(stamp_s) <= 1e6, "stamp_s must be at most a million seconds");
}

FaultPlan::FaultPlan(std::vector<FaultConfig> faults, int seed)
    : faults_(std::move(faults)), seed_(static_cast<std::uint64_t>(seed)) {
  for (const FaultConfig& fault : faults_) fault.Validate();
}

FaultVerdict FaultPlan::At(double script_s, std::uint64_t key) const {
  FaultVerdict verdict;
  std::uint64_t number = 0;  // Two drops at a time lose independently of each other.
  for (const FaultConfig& fault : faults_) {
    ++number;
    if (script_s < fault.from_s || script_s >= fault.to_s) continue;
    if (fault.fault == "silence") {
      verdict.lost = true;
    } else if (fault.fault == "drop") {
      verdict.lost = verdict.lost || Uniform(seed_ + (number << 32), key) < fault.ratio;
    } else if (fault.fault == "delay") {
      verdict.delay_ns += Ns(fault.delay_s);
    } else {
      verdict.stamp_shift_ns += Ns(fault.stamp_s);
      Eigen::Isometry3d T = Eigen::Isometry3d::Identity();
      T.linear() =
          Eigen::AngleAxisd(fault.yaw_deg * M_PI / 180.0, Eigen::Vector3d::UnitZ()).matrix();
      T.translation() = Eigen::Vector3d(fault.x_m, fault.y_m, fault.z_m);
      verdict.T_jump = T * verdict.T_jump;
    }
  }
  return verdict;
}

}  // namespace dendro
