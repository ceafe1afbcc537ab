#include <array>
#include <cmath>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/momentum.h"
#include "support/scenes.h"
#include "support/solids.h"
#include "support/tools.h"

/// The force that a tool reports is the one that the tissue received: nothing else changes the momentum of a free
/// block.
namespace tensormass::contact {
namespace {

constexpr double kSizeM = 0.04, kDtS = 1.0 / 240, kPenaltyPaPerM = 1e7;
constexpr int kSteps = 24;

/// How a scene steps.
struct Scheme {
  const char* name;
  v1::Solver::Integrator integrator;
  std::uint32_t newton_iterations;
  bool has_base_fields;  ///< another body is prescribed, so that implicit Euler is not plain
};
constexpr std::array<Scheme, 5> kSchemes{
    Scheme{"implicit Euler", v1::Solver::INTEGRATOR_IMPLICIT_EULER, 1, false},
    Scheme{"implicit Euler with base fields", v1::Solver::INTEGRATOR_IMPLICIT_EULER, 1, true},
    Scheme{"BDF2", v1::Solver::INTEGRATOR_BDF2, 1, false},
    Scheme{"implicit midpoint", v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT, 1, false},
    Scheme{"Newton", v1::Solver::INTEGRATOR_IMPLICIT_EULER, 30, false}};

/// Returns a free block in space, and a tool that touches its top.
v1::Scene block_under(const std::string& kind, const Scheme& scheme, v1::ContactMethod method, double friction,
                      bool double_precision) {
  v1::Scene scene = tests::beam_scene({.cells_x = 3,
                                       .cells_y = 3,
                                       .cells_z = 3,
                                       .size_x_m = kSizeM,
                                       .size_y_m = kSizeM,
                                       .size_z_m = kSizeM,
                                       .linear = true,
                                       .double_precision = double_precision,
                                       .young_modulus_pa = 5e3,
                                       .poisson_ratio = 0.3,
                                       .dt_s = kDtS,
                                       .cg_max_iterations = 5000,
                                       .cg_tolerance = double_precision ? 1e-13 : 1e-6});
  scene.clear_gravity_m_per_s2();
  scene.mutable_solver()->set_integrator(scheme.integrator);
  scene.mutable_solver()->set_newton_max_iterations(scheme.newton_iterations);
  scene.mutable_solver()->set_newton_tolerance(double_precision ? 1e-11 : 1e-6);
  const v1::Body block = scene.bodies(0);
  scene.mutable_bodies(0)->clear_fixed();
  if (scheme.has_base_fields) {
    v1::Body& far = *scene.add_bodies();
    far = block;
    far.set_name("far");
    tests::set(*far.mutable_mesh()->mutable_translation_m(), 1, -1, 0);  // below every tool
    far.clear_fixed();
    v1::PrescribedDisplacement& held = *far.add_prescribed();
    tests::set(*held.mutable_region()->mutable_box()->mutable_min_m(), 0.9, -2, -1);
    tests::set(*held.mutable_region()->mutable_box()->mutable_max_m(), 1.001, 1, 1);
    held.set_y_m(0);
  }
  const double touches_m = kSizeM + 0.0098;
  bool is_thin = false;
  for (const std::string& thin : tests::thin_tool_kinds()) is_thin = is_thin || thin == kind;
  if (is_thin) {
    tests::add_tool(scene, kind, 0.01, 0.021, touches_m, 0.019, kPenaltyPaPerM);
  } else {
    tests::add_solid(scene, kind, {0.03, 0.02, 0.03}, {0.021, touches_m, 0.019}, kPenaltyPaPerM);
  }
  scene.mutable_tools(0)->set_contact_method(method);
  scene.mutable_tools(0)->set_friction_coefficient(friction);
  return scene;
}

/// Impulses of a script [N s]: what the tool reports, what is missing in it, and the size of all steps' impulses.
struct Impulses {
  Vec3<double> missing = Vec3<double>::Zero();
  double worst_step = 0, size = 0, sideways = 0;
  int compared = 0;  ///< steps
};

/// Pushes the block down and sideways, then keeps the tool still. Not compared are steps that a guard made in parts,
/// because the report is of the last part, and those that Newton's method leaves above its tolerance.
Impulses push(world::World& world, const Scheme& scheme) {
  Impulses out;
  const bool is_bdf2 = scheme.integrator == v1::Solver::INTEGRATOR_BDF2;
  const bool keeps_force = world.model().tools[0].keeps_force;
  physics::Pose pose = world.model().tools[0].initial_pose;
  Vec3<double> before = tests::momentum_of(world), last = before, felt = Vec3<double>::Zero();
  bool starts_anew = true;  // by implicit Euler: the first step, and one after a jump of the force
  for (int i = 0; i < kSteps; ++i) {
    if (i < kSteps / 2) pose.position_m += Vec3<double>(0.15e-3, -0.3e-3, 0.1e-3);
    world.set_tool_target(0, pose);
    EXPECT_TRUE(world.step(false)) << "step " << i;
    const Vec3<double> now = tests::momentum_of(world), on_tissue = -world.readings()[0].force_n;
    // BDF2: M (3 v' − 4 v + v₋₁) / (2 dt) = F. With kept forces it makes steps of implicit Euler in contact.
    const bool by_euler = starts_anew || (keeps_force && !(felt.isZero(0) && on_tissue.isZero(0)));
    const Vec3<double> received = is_bdf2 && !by_euler ? Vec3<double>((3 * now - 4 * before + last) / 2) : now - before;
    const Vec3<double> missing = received - kDtS * on_tissue;
    if (world.guard_event() == nullptr && world.last().newton_residual <= world.model().newton_tolerance) {
      out.missing += missing;
      out.worst_step = std::max(out.worst_step, missing.norm());
      ++out.compared;
    }
    out.size += kDtS * on_tissue.norm();
    out.sideways += kDtS * std::hypot(on_tissue[0], on_tissue[2]);
    last = before;
    before = now;
    starts_anew = (on_tissue - felt).norm() > 0.1 * std::max(on_tissue.norm(), felt.norm());
    felt = on_tissue;
  }
  return out;
}

class Received : public tests::OnBackend {
 protected:
  template <class Visit>
  static void for_each_case(const Visit& visit) {
    std::vector<std::string> kinds = tests::thin_tool_kinds();
    for (const std::string& solid : tests::solid_kinds()) kinds.push_back(solid);
    for (const std::string& kind : kinds) {
      for (const v1::ContactMethod method : {v1::CONTACT_METHOD_PENALTY, v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN}) {
        for (const double friction : {0.0, 0.3}) {
          SCOPED_TRACE(kind + ", " + v1::ContactMethod_Name(method) + ", friction " + std::to_string(friction));
          visit(kind, method, friction);
        }
      }
    }
  }
};

TEST_P(Received, InDoublePrecisionWithinRounding) {
  for (const Scheme& scheme : kSchemes) {
    SCOPED_TRACE(scheme.name);
    for_each_case([&](const std::string& kind, v1::ContactMethod method, double friction) {
      const auto world = start(block_under(kind, scheme, method, friction, true));
      const Impulses impulses = push(*world, scheme);
      ASSERT_GT(impulses.size, 1e-5);
      if (friction > 0) {
        EXPECT_GT(impulses.sideways, 0.02 * impulses.size);
      }
      EXPECT_LT(impulses.worst_step, 1e-10 * impulses.size);
      EXPECT_GE(impulses.compared, scheme.newton_iterations > 1 ? 1 : kSteps - 4);
    });
  }
}

TEST_P(Received, InSinglePrecisionOverAScript) {
  for (const Scheme& scheme : kSchemes) {
    SCOPED_TRACE(scheme.name);
    for_each_case([&](const std::string& kind, v1::ContactMethod method, double friction) {
      const auto world = start(block_under(kind, scheme, method, friction, false));
      const Impulses impulses = push(*world, scheme);
      EXPECT_LT(impulses.missing.norm(), 1e-5 * impulses.size);
    });
  }
}

TM_ON_EACH_BACKEND(Received);

}  // namespace
}  // namespace tensormass::contact
