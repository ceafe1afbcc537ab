#include "support/staged_scene.h"

#include <thread>
#include <type_traits>
#include <vector>

#include "backend/cpu/elements.h"
#include "solver/coarse_rows.h"
#include "solver/row_sums.h"
#include "step/run.h"
#include "support/host_rows.h"

// TM_REAL, float or double, comes from the build.
namespace tensormass::tests {

namespace {

/// A team that takes one row at a time, as a thread of a GPU does. It hides kOneThread: stages then run what a GPU
/// runs.
class RowTeam : private backend::cpu::Team {
 public:
  using backend::cpu::Team::Team;
  using Team::exchange;
  using Team::for_each;
  using Team::for_lanes;
  using Team::leads;
  using Team::leads_patch;
  using Team::meet;
  using Team::patch;
  using Team::patch_sum;
  using Team::sync;
  template <class Real>
  using Lanes = SingleLane<Real>;
};

/// Computes W of solver/coarse_rows.h by Eigen; on a GPU a kernel does it.
template <class Real>
void invert(const view::CoarseView<Real>& coarse) {
  const auto n = static_cast<std::uint32_t>(solver::coarse_unknowns(coarse));
  // The sums are stored row by row: their lower triangle is the upper one of this matrix.
  const Eigen::Map<const Eigen::MatrixXd> upper(coarse.sums, n, n);
  const Eigen::MatrixXd factor = upper.transpose().selfadjointView<Eigen::Lower>().llt().matrixL();
  const Eigen::MatrixXd w = factor.triangularView<Eigen::Lower>().solve(Eigen::MatrixXd::Identity(n, n));
  for (std::uint32_t k = 0; k < n; ++k) {
    for (std::uint32_t j = 0; j <= k; ++j) {
      coarse.lower[solver::lower_place(k, j)] = coarse.upper[solver::upper_place(n, j, k)] = static_cast<Real>(w(k, j));
    }
  }
}

}  // namespace

template <class Real>
void StagedScene<Real>::run(const step::Stage& stage) {
  const view::ElementView<Real>& elements = groups_[stage.group];
  const auto on_each_patch_by = [&]<class Team>(std::type_identity<Team>, const auto& run_stage) {
    backend::cpu::Barrier barrier(view.patches.patch_count);
    std::vector<std::thread> threads;
    for (std::uint32_t patch = 0; patch < view.patches.patch_count; ++patch) {
      threads.emplace_back([&, patch] {
        Team team(patch, view.patches.patch_count, barrier);
        run_stage(team);
      });
    }
    for (std::thread& thread : threads) thread.join();
  };
  const auto on_each_patch = [&](const auto& run_stage) {
    on_each_patch_by(std::type_identity<backend::cpu::Team>{}, run_stage);
  };
  const auto by_rows = [&](const auto& run_stage) { on_each_patch_by(std::type_identity<RowTeam>{}, run_stage); };
  if (model.layout.storage == matrix::Storage::kRows) {  // assembled as on a GPU
    constexpr std::uint32_t kCapacity = 20;              // columns: most rows fit, some come in turns
    if (stage.info->kind == step::StageKind::kElements) {
      const model::ElementGroup& group = model.groups[stage.group];
      return assemble_rows(group.shape, group.law, view, elements, kCapacity);
    }
  }
  if (stage.info->kind == step::StageKind::kElements) {
    const model::ElementGroup& group = model.groups[stage.group];
    const auto pass = backend::cpu::element_passes<Real>(group.shape, group.law).tensors;
    on_each_patch([&](backend::cpu::Team& team) { pass(team, view, elements); });
  }
  if (uses_coarse_ && model.layout.storage == matrix::Storage::kRows) {
    if (stage.info->kind == step::StageKind::kRowErrors) {
      return by_rows(
          [&](RowTeam& team) { solver::measure_errors_of_rows(team, view.patches, view.state, view.matrix, coarse); });
    }
    if (stage.info->kind == step::StageKind::kCoarseLevel) {
      by_rows([&](RowTeam& team) {
        solver::sum_free_parts_of_rows(team, view.patches, view.state, view.matrix, coarse);
        if (!team.leads()) return;
        for (std::uint32_t pair = 0; pair < coarse_lists.pair_count; ++pair) {
          solver::assemble_coarse_pair(team, pair, view.patches, view.state, view.matrix, coarse, coarse_lists);
        }
        invert(coarse);
      });
      return;
    }
    if (stage.info->kind == step::StageKind::kSolve) {
      return by_rows([&](RowTeam& team) {
        solver::measure_losses_of_rows(team, view.patches, view.matrix, coarse);
        team.meet();
        std::vector<Real> vectors(4 * solver::coarse_unknowns(coarse));
        solver::RowsCoarseLevel<RowTeam, Real> level(team, view.patches, coarse, coarse_lists, coarse.lower,
                                                     coarse.upper, vectors.data());
        solver::conjugate_gradients(team, view.patches, view.state, view.matrix, view.solve, view.links, level);
      });
    }
  }
  if (uses_coarse_ && stage.info->kind == step::StageKind::kRowErrors) {
    return on_each_patch([&](backend::cpu::Team& team) {
      solver::measure_row_errors(team, view.patches, view.state, view.matrix, coarse);
    });
  }
  if (uses_coarse_ && stage.info->kind == step::StageKind::kCoarseLevel) {
    on_each_patch([&](backend::cpu::Team& team) {
      solver::sum_free_rows(team, view.patches, view.state, view.matrix, coarse);
      solver::assemble_coarse(team, view.patches, view.state, view.matrix, coarse);
    });
    return on_each_patch([&](backend::cpu::Team& team) { solver::factorize_coarse(team, view.patches, coarse); });
  }
  if (uses_coarse_ && stage.info->kind == step::StageKind::kSolve) {
    return on_each_patch([&](backend::cpu::Team& team) {
      solver::measure_row_losses(team, view.patches, view.matrix, coarse);
      solver::CoarseLevel<backend::cpu::Team, Real> level(team, view.patches, coarse);
      solver::conjugate_gradients(team, view.patches, view.state, view.matrix, view.solve, view.links, level);
    });
  }
  step::with_stage(model, stage, [&](auto type) {
    on_each_patch([&](backend::cpu::Team& team) { decltype(type)::run(team, view, elements); });
  });
}

template void StagedScene<TM_REAL>::run(const step::Stage&);

}  // namespace tensormass::tests
