#include <gtest/gtest.h>

#include <limits>

#include "haptic/hand_script.h"

namespace tensormass::haptic {
namespace {

HandScriptOptions options() {
  HandScriptOptions o;
  o.home_m = {0.0, 0.0, 0.1};
  o.contact_m = {0.0, 0.0, 0.02};
  o.direction = {0.0, 0.0, -3.0};
  o.depth_m = 0.015;
  o.circle_radius_m = 0.01;
  o.circle_count = 2.0;
  o.period_s = 4.0;
  return o;
}

TEST(HandScript, ApproachesPressesPalpatesLiftsAndRests) {
  const HandScript script = HandScript::create(options()).value();
  const auto at = [&](double phase) { return script.at(phase * 4.0).position_m; };
  EXPECT_LT((at(0.0) - options().home_m).norm(), 1e-12);
  EXPECT_LT((at(0.25) - options().contact_m).norm(), 1e-12);
  EXPECT_LT((at(0.40) - Eigen::Vector3d(0.0, 0.0, 0.005)).norm(), 1e-12);
  // Half-way through the circles the radius and the depth are at their largest.
  EXPECT_NEAR(at(0.60).head<2>().norm(), 0.01, 1e-12);
  EXPECT_NEAR(at(0.60).z(), 0.005, 1e-12);
  EXPECT_LT((at(0.97) - options().home_m).norm(), 1e-12);
  EXPECT_LT((script.at(4.0 * 7 + 1.7).position_m - script.at(1.7).position_m).norm(), 1e-12) << "periodic";
}

TEST(HandScript, VelocityIsTheDerivativeOfAContinuousPosition) {
  const HandScript script = HandScript::create(options()).value();
  constexpr double kH = 1e-6;
  for (double t = 0.0005; t < 8.0; t += 0.001) {
    const Eigen::Vector3d difference = (script.at(t + kH).position_m - script.at(t - kH).position_m) / (2.0 * kH);
    ASSERT_LT((difference - script.at(t).velocity_m_per_s).norm(), 1e-6) << "at " << t << " s";
  }
}

TEST(HandScript, NamesTheOptionThatItRefuses) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto message = [](auto change) {
    HandScriptOptions o = options();
    change(o);
    const auto script = HandScript::create(o);
    return script ? "" : script.error().message;
  };
  EXPECT_NE(message([](auto& o) { o.direction.setZero(); }).find("direction"), std::string::npos);
  EXPECT_NE(message([&](auto& o) { o.contact_m.x() = nan; }).find("contact"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.period_s = 0.0; }).find("period"), std::string::npos);
  EXPECT_NE(message([](auto& o) { o.depth_m = -1.0; }).find("depth"), std::string::npos);
  EXPECT_NE(message([&](auto& o) { o.circle_radius_m = nan; }).find("circles"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::haptic
