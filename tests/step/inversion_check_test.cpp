#include "step/inversion_check.h"

#include <gtest/gtest.h>

#include "support/dense_system.h"
#include "support/laws.h"
#include "support/staged_scene.h"

namespace tensormass::step {
namespace {

using step::StageKind;
using tests::StagedScene;

/// Compares det F from positions with det F from the rest shapes that the law reads.
TEST(LeastDetF, IsTheSameByEitherFormula) {
  for (const v1::Shape shape : tests::shapes()) {
    v1::Scene source = tests::beam_scene({.cells_x = 3, .cells_y = 2, .cells_z = 2, .double_precision = true});
    source.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
    StagedScene<double> staged(source, 2, matrix::Storage::kRows);
    staged.put(staged.view.state.displacement, tests::random_field(3 * staged.node_count(), 1, 4));
    backend::cpu::Arena arena;
    const auto e = model::bind<double>(staged.model, 0, arena);
    ASSERT_NE(e.reference_gradients, nullptr) << v1::Shape_Name(shape);
    double least_of_all = 1, most_of_all = -1;
    physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
      using Shape = typename decltype(tag)::Type;
      if (index != staged.model.groups[0].shape) return;
      for (std::uint32_t element = 0; element < e.count; ++element) {
        Vec3<double> u[Shape::kNodes];
        matrix::load_displacement<SingleLane<double>, Shape>(staged.view.state, e, element, u);
        double least = std::numeric_limits<double>::max();
        for (std::uint32_t q = 0; q < matrix::points_of<Shape>(e); ++q) {
          const matrix::StoredPoint<SingleLane<double>, Shape, matrix::NoLaw> stored(e, q, element);
          least = std::min(least, stored.gradients().deformation_gradient(u).determinant());
        }
        double of_some = std::numeric_limits<double>::infinity();
        for (std::uint32_t first = 0; first < kThreadsOfPoints; ++first) {
          of_some = std::min(of_some, least_det_f<Shape>(staged.view.state, e, element, first, kThreadsOfPoints));
        }
        if (least > 0) {
          EXPECT_EQ(of_some, std::numeric_limits<double>::infinity()) << v1::Shape_Name(shape);
        } else {
          EXPECT_NEAR(of_some, least, 1e-12) << v1::Shape_Name(shape);
        }
        least_of_all = std::min(least_of_all, least);
        most_of_all = std::max(most_of_all, least);
      }
    });
    EXPECT_LT(least_of_all, 0) << "else this shows less than it should";
    EXPECT_GT(most_of_all, 0) << "else this shows less than it should";
  }
}

/// Moves one node at a time until the worst element has a volume of plus or minus a ten-thousandth of its rest volume.
/// Positions are rounded to a third of that, at both ends of the scene.
TEST(CheckVolume, TellsBarelyInvertedElementsFromBarelyValidOnes) {
  for (const v1::Shape shape : tests::shapes()) {
    v1::Scene source = tests::beam_scene(
        {.cells_x = 500, .cells_y = 1, .cells_z = 1, .size_x_m = 1, .size_y_m = 2e-3, .size_z_m = 2e-3});
    source.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
    StagedScene<float> staged(source, 2);
    const StagedScene<double> exact(source, 2);  // the same rest positions as the scene in single precision
    for (std::size_t i = 0; i < staged.model.rest.size(); ++i) {
      const_cast<double*>(exact.view.state.rest)[i] = staged.view.state.rest[i];
    }
    backend::cpu::Arena arena;
    const auto e = model::bind<double>(exact.model, 0, arena);
    const auto least_of_all = [&] {
      double least = 1;
      physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
        if (index != exact.model.groups[0].shape) return;
        for (std::uint32_t element = 0; element < e.count; ++element) {
          least = std::min(least, least_det_f<typename decltype(tag)::Type>(exact.view.state, e, element));
        }
      });
      return least;
    };
    const Eigen::VectorXd ways = tests::random_field(3 * staged.node_count(), 1, 7);
    for (std::uint32_t node = 0; node < staged.node_count(); node += staged.node_count() / 40) {
      const std::uint32_t row = staged.row(node);
      Vec3<double> way = ways.segment<3>(3 * node);
      view::store3<double>(exact.view.state.displacement, row, way);
      if (least_of_all() == 1) {  // a node in the middle of an edge, outwards
        way = -way;
        view::store3<double>(exact.view.state.displacement, row, way);
      }
      const double inverted_at = 1 / (1 - least_of_all());  // det F changes linearly as one node goes straight on
      for (const double left : {1e-4, -1e-4}) {
        const Vec3<float> u = (way * (inverted_at * (1 - left))).cast<float>();
        view::store3<float>(staged.view.state.displacement, row, u);
        view::store3<double>(exact.view.state.displacement, row, u.cast<double>());
        for (std::uint32_t r = 0; r < staged.view.patches.row_count; ++r) {
          const Vec3<float> now =
              relative_rest(staged.view.state, r) + view::load3<float>(staged.view.state.displacement, r);
          view::store3<float>(staged.view.guard.relative_position, r, now);
        }
        staged.run(StageKind::kCheckInversion);
        const float found = *std::min_element(staged.view.guard.min_det_f,
                                              staged.view.guard.min_det_f + staged.view.patches.patch_count);
        if (left > 0) {
          EXPECT_EQ(found, std::numeric_limits<float>::infinity()) << v1::Shape_Name(shape) << ", node " << node;
        } else {
          EXPECT_NEAR(found, least_of_all(), 1e-5) << v1::Shape_Name(shape) << ", node " << node;
          EXPECT_LT(found, -5e-5) << v1::Shape_Name(shape) << ", node " << node;
        }
      }
      view::store3<float>(staged.view.state.displacement, row, Vec3<float>::Zero());
      view::store3<double>(exact.view.state.displacement, row, Vec3<double>::Zero());
    }
  }
}

}  // namespace
}  // namespace tensormass::step
