#include "dendro_slam/sensors/fault_plan.h"

#include <stdexcept>
#include <string>

#include <gtest/gtest.h>

namespace dendro {
namespace {

FaultConfig Fault(const std::string& kind, double from_s = 0.0, double to_s = 1e9) {
  FaultConfig fault;
  fault.fault = kind;
  fault.from_s = from_s;
  fault.to_s = to_s;
  return fault;
}

std::string ErrorOf(const FaultConfig& fault) {
  try {
    FaultPlan({fault}, 1);
  } catch (const std::invalid_argument& error) {
    return error.what();
  }
  return "";
}

TEST(FaultPlan, DoesNothingWithoutFaults) {
  const FaultVerdict verdict = FaultPlan().At(3.0, 7);
  EXPECT_FALSE(verdict.lost);
  EXPECT_EQ(verdict.delay_ns, 0);
  EXPECT_EQ(verdict.stamp_shift_ns, 0);
  EXPECT_TRUE(verdict.T_jump.isApprox(Eigen::Isometry3d::Identity()));
}

TEST(FaultPlan, SilenceHoldsFromItsBeginToBeforeItsEnd) {
  const FaultPlan plan({Fault("silence", 2.0, 3.0)}, 1);
  EXPECT_FALSE(plan.At(1.999, 0).lost);
  EXPECT_TRUE(plan.At(2.0, 0).lost);
  EXPECT_TRUE(plan.At(2.999, 0).lost);
  EXPECT_FALSE(plan.At(3.0, 0).lost);
}

TEST(FaultPlan, DropsItsShareAndTheSameOnesAgain) {
  FaultConfig fault = Fault("drop");
  fault.ratio = 0.2;
  const FaultPlan plan({fault}, 1);
  const FaultPlan same({fault}, 1);
  const FaultPlan other({fault}, 2);
  constexpr int kCount = 100000;
  int lost = 0;
  int both = 0;
  for (std::uint64_t key = 0; key < kCount; ++key) {
    // Stamps step by a packet's period; neighbours must be independent all the same.
    const bool gone = plan.At(1.0, 1700000000000000000ULL + key * 1327104).lost;
    EXPECT_EQ(gone, same.At(5.0, 1700000000000000000ULL + key * 1327104).lost);
    lost += gone ? 1 : 0;
    both += gone && other.At(1.0, 1700000000000000000ULL + key * 1327104).lost ? 1 : 0;
  }
  // Binomial: sigma 0.0013 and 0.0006; five of them.
  EXPECT_NEAR(lost / static_cast<double>(kCount), 0.2, 0.0065);
  EXPECT_NEAR(both / static_cast<double>(kCount), 0.04, 0.0031);
}

TEST(FaultPlan, DelaysAndStampJumpsAdd) {
  FaultConfig delay = Fault("delay", 0.0, 5.0);
  delay.delay_s = 0.25;
  FaultConfig late = Fault("delay", 2.0, 5.0);
  late.delay_s = 0.5;
  FaultConfig jump = Fault("jump", 3.0);
  jump.stamp_s = -1.5;
  const FaultPlan plan({delay, late, jump}, 1);
  EXPECT_EQ(plan.At(1.0, 0).delay_ns, 250000000);
  EXPECT_EQ(plan.At(2.5, 0).delay_ns, 750000000);
  EXPECT_EQ(plan.At(2.5, 0).stamp_shift_ns, 0);
  EXPECT_EQ(plan.At(6.0, 0).delay_ns, 0);
  EXPECT_EQ(plan.At(6.0, 0).stamp_shift_ns, -1500000000);
}

TEST(FaultPlan, APoseJumpLeavesMotionsAsTheyAre) {
  FaultConfig jump = Fault("jump", 1.0);
  jump.x_m = 2.0;
  jump.yaw_deg = 90.0;
  const Eigen::Isometry3d T_jump = FaultPlan({jump}, 1).At(1.0, 0).T_jump;
  // By hand: (1, 0, 0) turns to (0, 1, 0) and moves by (2, 0, 0).
  EXPECT_TRUE((T_jump * Eigen::Vector3d(1, 0, 0)).isApprox(Eigen::Vector3d(2, 1, 0), 1e-12));
  Eigen::Isometry3d T_a = Eigen::Isometry3d::Identity();
  T_a.translation() = Eigen::Vector3d(1, 2, 3);
  Eigen::Isometry3d T_b = T_a;
  T_b.linear() = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitX()).matrix();
  T_b.translation() += Eigen::Vector3d(0.1, 0, 0);
  EXPECT_TRUE(((T_jump * T_a).inverse() * (T_jump * T_b)).isApprox(T_a.inverse() * T_b, 1e-12));
}

TEST(FaultConfig, SaysWhatIsWrong) {
  EXPECT_NE(ErrorOf(Fault("explode")).find("drop, delay, jump or silence"), std::string::npos);
  EXPECT_NE(ErrorOf(Fault("silence", 3.0, 3.0)).find("to_s"), std::string::npos);
  EXPECT_NE(ErrorOf(Fault("silence", -1.0)).find("from_s"), std::string::npos);
  EXPECT_NE(ErrorOf(Fault("drop")).find("ratio"), std::string::npos);
  EXPECT_NE(ErrorOf(Fault("delay")).find("delay_s"), std::string::npos);
  EXPECT_NE(ErrorOf(Fault("jump")).find("stamp_s"), std::string::npos);
  FaultConfig mixed = Fault("silence");
  mixed.x_m = 1.0;
  EXPECT_NE(ErrorOf(mixed).find("belong to jump"), std::string::npos);
  mixed = Fault("silence");
  mixed.ratio = 0.5;
  EXPECT_NE(ErrorOf(mixed).find("belongs to drop"), std::string::npos);
}

}  // namespace
}  // namespace dendro
