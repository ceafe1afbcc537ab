#include <cmath>

#include <gtest/gtest.h>

#include "mesh/surface.h"
#include "model/scene_input.h"
#include "support/backends.h"
#include "support/dense_system.h"
#include "support/laws.h"
#include "support/meshes.h"
#include "support/scenes.h"
#include "world/fields.h"
#include "world/findings.h"

/// Time schemes, equilibria, loads and fields against analytical mechanics. Every change must pass these
/// checks; the tables of docs/accuracy.md go further.
namespace tensormass::world {
namespace {

class Analysis : public tests::OnBackend {
 protected:
  /// A bar 0.4 × 0.1 × 0.1 m of 4 × 2 × 2 cells, clamped at x = 0, without gravity. Double precision, solved to
  /// rounding.
  static v1::Scene bar(v1::Shape shape = v1::SHAPE_HEXAHEDRON, const std::string& law = "hooke", double poisson = 0.3) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 0.4,
                                         .size_y_m = 0.1,
                                         .size_z_m = 0.1,
                                         .double_precision = true,
                                         .cg_max_iterations = 5000,
                                         .cg_tolerance = 1e-13});
    scene.clear_gravity_m_per_s2();
    scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
    *scene.mutable_bodies(0)->mutable_law() = tests::law(law, 1e5, poisson);
    return scene;
  }
  static void quasi_static(v1::Scene& scene, double tolerance = 1e-10) {
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->set_newton_tolerance(tolerance);
  }
  static void at_end(v1::Region& region, double x = 0.4) {
    tests::set(*region.mutable_box()->mutable_min_m(), x - 1e-6, -1, -1);
    tests::set(*region.mutable_box()->mutable_max_m(), x + 1e-6, 1, 1);
  }
  static v1::GetFieldsResponse fields(World& world, std::initializer_list<v1::Field> wanted) {
    v1::GetFieldsRequest request;
    for (const v1::Field field : wanted) request.add_fields(field);
    return measure_fields(world.model(), world.state(), world.simulated_time_s(), world.model().bodies[0], request)
        .value();
  }
  static Eigen::MatrixXd values(const v1::FieldValues& field) {
    const auto components = static_cast<Eigen::Index>(field.components());
    const auto count = static_cast<Eigen::Index>(field.values().size() / sizeof(double)) / components;
    return Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>(
        reinterpret_cast<const double*>(field.values().data()), count, components);
  }
  static Eigen::MatrixXd one(World& world, v1::Field field) { return values(fields(world, {field}).fields(0)); }
};

/// The bar's first swing after its load is removed, compared with a run whose steps are a hundred times shorter. The
/// error falls with dt for implicit Euler and with dt² for BDF2.
TEST_P(Analysis, TimeSchemesHaveTheirOrder) {
  const auto tip = [&](v1::Solver::Integrator integrator, int steps) {
    v1::Scene scene = bar();
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
    scene.mutable_solver()->set_integrator(integrator);
    constexpr double kSpan = 0.06;
    scene.mutable_stepping()->set_dt_s(kSpan / steps);
    const auto world = start(scene);
    for (int i = 0; i < steps; ++i) EXPECT_TRUE(world->step(false));
    return one(*world, v1::FIELD_DISPLACEMENT)(4, 1);
  };
  const double exact = tip(v1::Solver::INTEGRATOR_BDF2, 3200);
  ASSERT_LT(exact, -1e-3);
  const auto ratio = [&](v1::Solver::Integrator integrator) {
    return (tip(integrator, 60) - exact) / (tip(integrator, 120) - exact);
  };
  EXPECT_NEAR(ratio(v1::Solver::INTEGRATOR_IMPLICIT_EULER), 2, 0.15);
  EXPECT_NEAR(ratio(v1::Solver::INTEGRATOR_BDF2), 4, 0.4);
}

/// Newton's method reduces the residual of a large bend to rounding, for every nonlinear law.
TEST_P(Analysis, NewtonReachesEquilibriumOfEveryLaw) {
  for (const std::string& law : tests::law_names()) {
    v1::Scene scene = bar(v1::SHAPE_HEXAHEDRON, law);
    quasi_static(scene);
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    at_end(*load.mutable_region());
    tests::set(*load.mutable_traction_pa(), 0, 0, 600);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    EXPECT_TRUE(world->last().converged) << law << " " << world->last().newton_residual;
    EXPECT_LT(world->last().newton_iterations, 15u) << law;
    const auto all = fields(*world, {v1::FIELD_DISPLACEMENT, v1::FIELD_REACTION_FORCE});
    EXPECT_GT(values(all.fields(0)).col(2).maxCoeff(), 0.05) << law << " bends far";
    const Eigen::RowVector3d reaction = values(all.fields(1)).colwise().sum();
    EXPECT_LT((reaction + Eigen::RowVector3d(0, 0, 6)).norm(), 1e-7) << law << ": 600 Pa on 0.01 m²";
  }
}

/// The first increment turns a nearly incompressible body before it bends it, and passes through forces far above those
/// that it ends with. In single precision, too, the residual is measured against the latter.
TEST_P(Analysis, ALooseToleranceEndsNearTheEquilibriumInSinglePrecision) {
  const auto tip = [&](bool double_precision, double tolerance) {
    v1::Scene scene = bar(v1::SHAPE_HEXAHEDRON, "stable_neo_hookean", 0.499);
    scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
    quasi_static(scene, tolerance);
    if (!double_precision) {
      scene.mutable_solver()->set_precision(v1::Solver::PRECISION_FLOAT);
      scene.mutable_solver()->set_cg_tolerance(1e-4);
    }
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    at_end(*load.mutable_region());
    tests::set(*load.mutable_traction_pa(), 0, 0, 300);
    const auto world = start(scene);
    EXPECT_TRUE(world->step(false));
    EXPECT_TRUE(world->last().converged);
    return one(*world, v1::FIELD_DISPLACEMENT).col(2).maxCoeff();
  };
  const double exact = tip(true, 1e-10), loose = 0.01;
  EXPECT_NEAR(tip(true, loose), exact, loose / 4 * exact);
  EXPECT_NEAR(tip(false, loose), exact, loose / 4 * exact);
}

/// A consistent mass couples the acceleration of prescribed nodes to their neighbours. For a linear law one solve is
/// exact, so a second one must change nothing.
TEST_P(Analysis, ALinearStepNeedsOneSolveAlsoWithPrescribedNodes) {
  const auto end_after = [&](std::uint32_t solves) {
    v1::Scene scene = bar();
    scene.mutable_bodies(0)->set_mass(v1::MASS_CONSISTENT);
    scene.mutable_solver()->set_newton_max_iterations(solves);
    scene.mutable_solver()->set_newton_tolerance(1e-12);
    v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
    at_end(*end.mutable_region());
    end.set_y_m(0.01);
    end.mutable_schedule()->add_time_s(0);
    end.mutable_schedule()->add_time_s(0.05);
    end.mutable_schedule()->add_factor(0);
    end.mutable_schedule()->add_factor(1);
    const auto world = start(scene);
    for (int step = 0; step < 5; ++step) EXPECT_TRUE(world->step(false));
    return Eigen::MatrixXd(one(*world, v1::FIELD_DISPLACEMENT));
  };
  const Eigen::MatrixXd once = end_after(1), thrice = end_after(3);
  EXPECT_LT((once - thrice).norm(), 1e-9 * once.norm());
}

/// An affine displacement of the boundary is an affine displacement inside: in every shape, and where shapes meet.
TEST_P(Analysis, PatchTest) {
  const auto check = [&](v1::Scene scene, const std::string& what) {
    quasi_static(scene, 1e-12);
    v1::Body& body = *scene.mutable_bodies(0);
    body.clear_fixed();
    const mesh::Mesh mesh = model::read_mesh(body, "body").value();
    const Mat3<double> gradient = (Mat3<double>() << 0.02, 0.05, -0.03, 0.01, -0.04, 0.02, 0.03, 0.01, 0.06).finished();
    const mesh::Surface surface = mesh::boundary(mesh);
    for (const std::uint32_t node : surface.nodes) {
      v1::PrescribedDisplacement& p = *body.add_prescribed();
      p.mutable_region()->mutable_nodes()->add_indices(node);
      const Vec3<double> u = gradient * mesh.nodes[node];
      p.set_x_m(u[0]);
      p.set_y_m(u[1]);
      p.set_z_m(u[2]);
    }
    ASSERT_LT(surface.nodes.size(), mesh.nodes.size()) << "there is an inside";
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    const Eigen::MatrixXd u = one(*world, v1::FIELD_DISPLACEMENT);
    double error = 0;
    for (std::size_t node = 0; node < mesh.nodes.size(); ++node) {
      error =
          std::max(error, (u.row(static_cast<Eigen::Index>(node)).transpose() - gradient * mesh.nodes[node]).norm());
    }
    EXPECT_LT(error, 1e-11) << what;
    const Eigen::MatrixXd stress = one(*world, v1::FIELD_CAUCHY_STRESS);
    EXPECT_LT((stress.rowwise() - stress.row(0)).norm(), 1e-8 * stress.norm())
        << what << ": the stress is the same all over";
    const Mat3<double> small = (gradient + gradient.transpose()) / 2;
    const Mat3<double> strain =
        body.law().has_hooke() ? small : Mat3<double>(small + gradient.transpose() * gradient / 2);
    const double largest = Eigen::SelfAdjointEigenSolver<Mat3<double>>(strain).eigenvalues()[2];
    EXPECT_LT((one(*world, v1::FIELD_LARGEST_STRAIN).array() - largest).abs().maxCoeff(), 1e-9) << what;
  };
  for (const v1::Shape shape : tests::shapes()) {
    for (const auto quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
      for (const char* law : {"hooke", "st_venant_kirchhoff", "stable_neo_hookean"}) {
        v1::Scene scene = bar(shape, law);
        scene.mutable_bodies(0)->set_quadrature(quadrature);
        check(scene, v1::Shape_Name(shape) + " " + law);
      }
    }
  }
  v1::Scene mixed = tests::packed_scene(tests::mixed_mesh(), false);
  check(mixed, "all linear shapes, distorted");
  mixed.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
  check(mixed, "all linear shapes, distorted, selective");
}

/// A nearly incompressible bar of clusters bends like one of hexahedra, which do not lock. Its axis of bending lies
/// across the triangles of wedges. Wedges and tetrahedra whose volume changes alone are far too stiff.
TEST_P(Analysis, SelectiveClustersDoNotLock) {
  const auto tip = [&](v1::Shape shape) {
    v1::Scene scene = bar(shape, "hooke", 0.4999);
    v1::Body& body = *scene.mutable_bodies(0);
    body.mutable_mesh()->mutable_grid()->set_cells_x(16);
    body.mutable_mesh()->mutable_grid()->set_cells_y(8);
    body.set_quadrature(v1::QUADRATURE_SELECTIVE);
    v1::PrescribedDisplacement& flat = *body.add_prescribed();  // plane strain
    tests::set(*flat.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*flat.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    flat.set_z_m(0);
    v1::Load& load = *body.add_loads();
    at_end(*load.mutable_region());
    tests::set(*load.mutable_traction_pa(), 0, 1, 0);
    quasi_static(scene);
    const auto world = start(scene);
    EXPECT_TRUE(world->step(false));
    return one(*world, v1::FIELD_DISPLACEMENT).col(1).maxCoeff();
  };
  const double hexahedra = tip(v1::SHAPE_HEXAHEDRON);
  EXPECT_NEAR(tip(v1::SHAPE_WEDGE), hexahedra, 0.15 * hexahedra);
  EXPECT_NEAR(tip(v1::SHAPE_TETRAHEDRON), hexahedra, 0.15 * hexahedra);
}

/// Steps and fields must compute the same mechanics. In equilibrium, reactions are the derivative of the energy with
/// respect to the prescribed displacements, also for clusters. The elements hold all of the energy.
TEST_P(Analysis, ReactionsAreTheDerivativeOfTheEnergy) {
  for (const std::string& law : tests::law_names()) {
    const auto at = [&](double step) {
      v1::Scene scene = tests::packed_scene(tests::mixed_mesh(), false);
      quasi_static(scene, 1e-12);
      scene.mutable_solver()->set_cg_max_iterations(5000);
      scene.mutable_solver()->set_cg_tolerance(1e-13);
      v1::Body& body = *scene.mutable_bodies(0);
      *body.mutable_law() = tests::law(law, 1e5, 0.45);
      body.set_quadrature(v1::QUADRATURE_SELECTIVE);
      for (const double x : {0.0, 2.0}) {
        v1::PrescribedDisplacement& end = *body.add_prescribed();
        at_end(*end.mutable_region(), x);
        end.set_x_m(x == 0 ? 0 : 0.1 + step);
        end.set_y_m(x == 0 ? 0 : 0.2 + 2 * step);
        end.set_z_m(x == 0 ? 0 : -0.1 + 3 * step);
      }
      const auto world = start(scene);
      EXPECT_TRUE(world->step(false));
      return fields(*world, {v1::FIELD_REACTION_FORCE, v1::FIELD_DISPLACEMENT, v1::FIELD_ELASTIC_ENERGY});
    };
    const v1::GetFieldsResponse here = at(0);
    const Eigen::MatrixXd reaction = values(here.fields(0)), u = values(here.fields(1));
    double work = 0;
    for (Eigen::Index node = 0; node < u.rows(); ++node) {
      if (u.row(node).isApprox(Eigen::RowVector3d(0.1, 0.2, -0.1), 1e-14)) {
        work += reaction.row(node).dot(Eigen::RowVector3d(1, 2, 3));
      }
    }
    constexpr double kStep = 1e-5;
    const double slope = (at(kStep).elastic_energy_j() - at(-kStep).elastic_energy_j()) / (2 * kStep);
    EXPECT_GT(std::abs(work), 100) << law;
    EXPECT_NEAR(slope, work, 1e-6 * std::abs(work)) << law;
    EXPECT_NEAR(values(here.fields(2)).sum(), here.elastic_energy_j(), 1e-12 * here.elastic_energy_j()) << law;
    EXPECT_GT(values(here.fields(2)).minCoeff(), 0) << law;
  }
}

/// Prescribed nodes follow u = schedule(t) · displacement in the prescribed directions. Other directions stay free.
TEST_P(Analysis, PrescribedNodesFollowTheirPrescribedDisplacement) {
  for (const bool dynamic : {true, false}) {
    v1::Scene scene = bar(v1::SHAPE_TETRAHEDRON, "st_venant_kirchhoff");
    if (!dynamic) quasi_static(scene);
    v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
    at_end(*end.mutable_region());
    end.set_x_m(0.04);
    for (const auto& [time, factor] : {std::pair{0.0, 0.0}, std::pair{0.04, 1.0}, std::pair{0.08, -0.5}}) {
      end.mutable_schedule()->add_time_s(time);
      end.mutable_schedule()->add_factor(factor);
    }
    const auto world = start(scene);
    for (int step = 1; step <= 10; ++step) {
      ASSERT_TRUE(world->step(false));
      const double t = 0.01 * step;
      const double expected = 0.04 * (t <= 0.04 ? t / 0.04 : t <= 0.08 ? 1 - 1.5 * (t - 0.04) / 0.04 : -0.5);
      const Eigen::MatrixXd u = one(*world, v1::FIELD_DISPLACEMENT);
      EXPECT_NEAR(u(4, 0), expected, 1e-12) << step;
      if (step == 4) {
        EXPECT_GT(std::abs(u(4, 1)), 1e-4) << "it narrows, being free to";
      }
    }
    const Eigen::MatrixXd reaction = one(*world, v1::FIELD_REACTION_FORCE);
    EXPECT_EQ(reaction(4, 1), 0) << "a free direction is held by nothing";
    if (!dynamic) {
      EXPECT_LT(reaction.colwise().sum().norm(), 1e-7) << "in equilibrium what holds balances";
      EXPECT_LT(reaction.col(0).segment(4, 1)[0], 0) << "pressed";
    }
  }
}

/// The matrix has the stiffness of pressure on a closed surface, so Newton's method converges at its full rate, also
/// where the block shrinks by much. On a surface with a free rim it is not symmetric and left out.
TEST_P(Analysis, NewtonConvergesFastUnderPressure) {
  for (const v1::Shape shape : tests::shapes()) {
    v1::Scene scene = bar(shape, "neo_hookean");
    quasi_static(scene);
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    load.set_pressure_pa(1e4);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    EXPECT_TRUE(world->last().converged);
    EXPECT_LE(world->last().newton_iterations, 6u) << v1::Shape_Name(shape);
  }
}

/// A pressure p on the whole surface of a free block compresses its volume by p / K and does not move it.
TEST_P(Analysis, PressureAllAroundIsHydrostatic) {
  for (const v1::Shape shape : tests::shapes()) {
    v1::Scene scene = bar(shape, "hooke");
    v1::Body& body = *scene.mutable_bodies(0);
    body.clear_fixed();
    for (int c = 0; c < 3; ++c) {  // fixed by three planes of symmetry
      v1::PrescribedDisplacement& plane = *body.add_prescribed();
      tests::set(*plane.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
      tests::set(*plane.mutable_region()->mutable_box()->mutable_max_m(), c == 0 ? 1e-6 : 1, c == 1 ? 1e-6 : 1,
                 c == 2 ? 1e-6 : 1);
      if (c == 0) plane.set_x_m(0);
      if (c == 1) plane.set_y_m(0);
      if (c == 2) plane.set_z_m(0);
    }
    quasi_static(scene);
    v1::Load& load = *body.add_loads();
    tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    const double pressure = 1, bulk = 1e5 / (3 * (1 - 2 * 0.3));
    load.set_pressure_pa(pressure);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    const auto all = fields(*world, {v1::FIELD_CAUCHY_STRESS, v1::FIELD_VON_MISES_STRESS});
    EXPECT_NEAR(all.min_det_f(), 1 - pressure / bulk, 1e-9) << v1::Shape_Name(shape);
    EXPECT_LT((values(all.fields(0)).leftCols(3).array() + pressure).abs().maxCoeff(), 1e-4) << v1::Shape_Name(shape);
    EXPECT_LT(values(all.fields(1)).maxCoeff(), 1e-4) << v1::Shape_Name(shape);
    EXPECT_NEAR(all.elastic_energy_j(), 0.5 * pressure * pressure / bulk * 0.004, 1e-12) << v1::Shape_Name(shape);
  }
}

/// After a sudden constant stretch, the stress of every law relaxes to 1 − α of its first value. Also holds for
/// clusters, which have internal variables of their own beside those of their elements.
TEST_P(Analysis, ViscoelasticityRelaxesEveryLaw) {
  for (const std::string& law : tests::law_names()) {
    for (const v1::Shape shape : {v1::SHAPE_HEXAHEDRON, v1::SHAPE_WEDGE, v1::SHAPE_TETRAHEDRON}) {
      const std::string what = v1::Shape_Name(shape) + " " + law;
      v1::Scene scene = bar(shape, law);
      v1::Body& body = *scene.mutable_bodies(0);
      if (shape != v1::SHAPE_HEXAHEDRON) body.set_quadrature(v1::QUADRATURE_SELECTIVE);
      quasi_static(scene);
      scene.mutable_stepping()->set_dt_s(0.05);
      v1::PronyTerm& term = *body.mutable_law()->add_prony();
      term.set_share(0.6);
      term.set_relaxation_time_s(0.2);
      v1::PrescribedDisplacement& end = *body.add_prescribed();
      at_end(*end.mutable_region());
      end.set_x_m(0.02);
      end.set_y_m(0);
      end.set_z_m(0);
      const auto world = start(scene);
      const auto pull = [&] {
        EXPECT_TRUE(world->step(false));
        return one(*world, v1::FIELD_REACTION_FORCE)(4, 0);
      };
      const double first = pull();
      double last = first;
      for (int step = 2; step <= 100; ++step) last = pull();
      const double after_one = 1 - 0.6 * 0.05 / 0.25;  // implicit Euler's first step
      EXPECT_NEAR(last / first, 0.4 / after_one, 1e-4) << what;
      EXPECT_GT(first, 0.01) << what;
    }
  }
}

TEST_P(Analysis, DiagnosticsMeasureStrainAndCompression) {
  v1::Scene scene = bar(v1::SHAPE_TETRAHEDRON, "hooke");
  quasi_static(scene);
  v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
  at_end(*end.mutable_region());
  end.set_x_m(-0.2);
  const auto world = start(scene);
  world->diagnose();
  EXPECT_EQ(world->diagnostics()[0].min_det_f, 1);
  EXPECT_EQ(world->diagnostics()[0].max_strain, 0);
  ASSERT_TRUE(world->step(false));
  world->diagnose();
  EXPECT_NEAR(world->diagnostics()[0].max_strain, 0.5, 0.1);
  EXPECT_LT(world->diagnostics()[0].min_det_f, 0.75);
  EXPECT_NEAR(world->diagnostics()[0].min_det_f, fields(*world, {}).min_det_f(), 1e-12);
  world->reset();
  EXPECT_EQ(world->diagnostics()[0].max_strain, 0);
}

/// Elements and their clusters are two element groups but give one warning.
TEST_P(Analysis, LeavingTheLinearRangeGivesOneWarning) {
  v1::Scene scene = bar(v1::SHAPE_WEDGE, "hooke");
  scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
  quasi_static(scene);
  v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
  at_end(*end.mutable_region());
  end.set_x_m(-0.2);
  const auto world = start(scene);
  ASSERT_TRUE(world->step(false));
  world->diagnose();
  const IterationBudget budget(world->model());
  Findings findings(world->shared_model(), budget);
  findings.take_diagnostics(*world);
  v1::SceneStatus status;
  findings.add_to(status);
  ASSERT_EQ(status.warnings_size(), 1);
  EXPECT_NE(status.warnings(0).find("hooke has left its range"), std::string::npos) << status.warnings(0);
  EXPECT_LT(status.min_det_f(), 0.75);
}

TM_ON_EACH_BACKEND(Analysis);

}  // namespace
}  // namespace tensormass::world
