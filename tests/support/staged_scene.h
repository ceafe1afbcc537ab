#pragma once

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string_view>
#include <utility>
#include <vector>

#include <Eigen/Dense>

#include "backend/cpu/arena.h"
#include "backend/step_inputs.h"
#include "model/bind.h"
#include "model/coarse_lists.h"
#include "model/compile.h"
#include "step/stages.h"

/// A compiled scene on CPU teams: a test runs its stages one by one and has access to every buffer.
namespace tensormass::tests {

/// Compiles or throws the refusal, which ends a test with its message. Exactly `patches` patches.
inline model::Model compile_into(const v1::Scene& scene, std::uint32_t patches, matrix::Storage storage) {
  auto model = model::compile(scene, {patches, 1, storage});
  if (!model) throw std::runtime_error(model.error().message);
  return std::move(*model);
}

template <class Real>
class StagedScene {
 public:
  explicit StagedScene(const v1::Scene& scene, std::uint32_t patches = 1,
                       matrix::Storage storage = matrix::Storage::kEdges)
      : model(compile_into(scene, patches, storage)),
        bound_(model::bind<Real>(model, arena_)),
        stages_(step::list_stages(model)) {
    for (std::size_t g = 0; g < model.groups.size(); ++g) groups_.push_back(model::bind<Real>(model, g, arena_));
    *inputs.control = backend::control_of<Real>(
        model, {.dt_s = model.dt_s, .cg_max_iterations = model.cg_max_iterations, .projects_stiffness = true}, {});
  }

  /// Runs the model's stages up to and with `last`, each by all patches.
  void run_through(step::StageKind last) {
    // The stages of one linearized step run in the order of their kinds.
    for (const step::Stage& stage : stages_) {
      if (stage.info->kind <= last) run(stage);
    }
  }
  void run(step::StageKind kind) {
    for (const step::Stage& stage : stages_) {
      if (stage.info->kind == kind) run(stage);
    }
  }
  /// In staged_scene.cpp: all stages together take minutes to compile.
  void run(const step::Stage& stage);
  void step() { run_through(step::StageKind::kMeasureContact); }
  /// From now on, the stages of the solve have a coarse level. The model must have aggregates.
  void use_coarse_level() { uses_coarse_ = true; }

  std::uint32_t node_count() const { return static_cast<std::uint32_t>(model.layout.row_of_node.size()); }
  std::uint32_t row(std::uint32_t node) const { return model.layout.row_of_node[node]; }
  bool is_fixed(std::uint32_t node) const { return model.rest[4 * std::size_t{row(node)} + 3] == 0; }

  /// Converts a field of rows to one vector in node order, [3 node_count], and back.
  Eigen::VectorXd by_node(const Real* rows) const {
    Eigen::VectorXd out(3 * node_count());
    for (std::uint32_t node = 0; node < node_count(); ++node) {
      out.segment<3>(3 * node) = view::load3<Real>(rows, row(node)).template cast<double>();
    }
    return out;
  }
  void put(Real* rows, const Eigen::VectorXd& by_node) const {
    for (std::uint32_t node = 0; node < node_count(); ++node) {
      view::store3<Real>(rows, row(node), Vec3<double>(by_node.segment<3>(3 * node)).template cast<Real>());
    }
  }

  /// Returns the view's matrix in node order: the assembled, unscaled matrix if `with_diagonal`, else only the scaled
  /// edges.
  Eigen::MatrixXd matrix(bool with_diagonal = true) const {
    Eigen::MatrixXd a = Eigen::MatrixXd::Zero(3 * node_count(), 3 * node_count());
    const auto node_of = [&](const view::Patch& patch, std::uint32_t column) {
      return model.layout.node_of_row[view::global_row(view.patches, patch, column)];
    };
    for (std::uint32_t p = 0; matrix::stores_edges(view.matrix) && p < view.patches.patch_count; ++p) {
      const view::Patch patch = view::patch_of(view.patches, p);
      matrix::for_each_edge(
          view.matrix, patch, [&](std::size_t slot, std::uint32_t own, std::uint32_t column, bool both) {
            const std::uint32_t node = node_of(patch, own), other = node_of(patch, column);
            if (node == mesh::kNone) return;
            const Mat3<double> block =
                (with_diagonal ? matrix::load_edge<Real>(view.matrix.edges, slot) : load_scaled_edge(slot))
                    .template cast<double>();
            a.block<3, 3>(3 * node, 3 * other) += block;
            if (both) a.block<3, 3>(3 * other, 3 * node) += block.transpose();
          });
    }
    for (std::uint32_t node = 0; !matrix::stores_edges(view.matrix) && node < node_count(); ++node) {
      const view::Patch patch = view::patch_of(view.patches, model.layout.patch_of_row(row(node)));
      view::for_each_slot(view.matrix, row(node), [&](std::size_t slot, std::uint32_t column) {
        const std::uint32_t other = model.layout.node_of_row[view::global_row(view.patches, patch, column)];
        a.block<3, 3>(3 * node, 3 * other) += view::load_block<Real>(view.matrix.edges, slot).template cast<double>();
      });
    }
    for (std::uint32_t node = 0; with_diagonal && node < node_count(); ++node) {
      const Real* d = view.matrix.diagonal + std::size_t{8} * row(node);
      Mat3<double> block;
      block << d[0], d[1], d[2], d[1], d[3], d[4], d[2], d[4], d[5];
      a.block<3, 3>(3 * node, 3 * node) += block;
    }
    return a;
  }
  /// Writes a block of the scaled matrix and, by symmetry, its transpose.
  void put_scaled_block(std::uint32_t row_k, std::uint32_t row_l, const Mat3<Real>& block) const {
    model.layout.for_each_place(row_k, row_l, [&](std::uint32_t slot, bool transposed) {
      const Mat3<Real> stored = transposed ? Mat3<Real>(block.transpose()) : block;
      for (int c = 0; c < 9; ++c) view.matrix.edges[scaled_component(slot, c)] = stored(c / 3, c % 3);
    });
  }

 private:
  std::size_t scaled_component(std::size_t slot, int c) const {
    const std::size_t height = model.layout.slice_rows();
    return slot / height * (9 * height) + slot % height + static_cast<std::size_t>(c) * height;
  }
  Mat3<Real> load_scaled_edge(std::size_t slot) const {
    Mat3<Real> block;
    for (int c = 0; c < 9; ++c) block(c / 3, c % 3) = view.matrix.edges[scaled_component(slot, c)];
    return block;
  }

  backend::cpu::Arena arena_;

 public:
  const model::Model model;

 private:
  model::BoundScene<Real> bound_;

 public:
  view::SceneView<Real> view = bound_.view;
  model::HostInputs<Real> inputs = bound_.inputs;
  view::CoarseView<Real> coarse = model::bind_coarse<Real>(model, arena_);
  solver::CoarseLists coarse_lists =
      model.layout.storage == matrix::Storage::kRows ? model::bind_coarse_lists(model, arena_) : solver::CoarseLists{};

 private:
  bool uses_coarse_ = false;
  const std::vector<step::Stage> stages_;
  std::vector<view::ElementView<Real>> groups_;
};

}  // namespace tensormass::tests
