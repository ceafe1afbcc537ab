#pragma once

#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "mesh/cut_search.h"
#include "model/compile.h"
#include "model/cut_bodies.h"
#include "support/backends.h"
#include "support/editing.h"
#include "world/cut_state.h"
#include "world/world.h"

/// Scenes whose bodies are cut, and worlds that go on from the moment of a cut.
namespace tensormass::tests {

/// The points of a blade [m], in the mesh at rest.
using Blade = std::vector<Eigen::Vector3d>;

/// The first body of a scene, and what blades have cut of it.
class CutBody {
 public:
  explicit CutBody(const v1::Scene& scene) {
    auto made = model::BodyCut::make(bodies_of(scene).bodies[0]);
    if (!made) throw std::runtime_error(made.error().message);
    cut_ = std::move(*made);
    search_ = std::make_unique<mesh::CutSearch>(cut_->topology());
    room_.resize(cut_->topology().edge_count());
  }

  /// Moves a blade and cuts what it crosses, but frees no crumb.
  void move(const Blade& before, const Blade& after) {
    const mesh::Sweep sweep = search_->sweep(before, after, room_);
    if (sweep.refused) throw std::runtime_error(std::string(words(sweep.refusal)));
    std::vector<mesh::CutEdge> edges = cut_->without_crumbs({sweep.edges.begin(), sweep.edges.end()});
    left_whole_ += sweep.edges.size() - edges.size();
    const auto made = cut_->make_cut(++order_, std::move(edges));
    if (!made) throw std::runtime_error(made.error().message);
  }
  /// Moves a straight blade across a box by random positions and directions.
  void move_at_random(std::mt19937& random, const Eigen::Vector3d& size_m) {
    std::uniform_real_distribution<double> uniform(-0.2, 1.2);
    const auto point = [&] {
      return Eigen::Vector3d(Eigen::Vector3d::NullaryExpr([&] { return uniform(random); }).cwiseProduct(size_m));
    };
    const Blade before{point(), point()};
    move(before, {point(), point()});
  }

  /// The cuts so far, as compile takes them.
  model::SceneCuts cuts() const { return {cut_->copy()}; }
  const model::BodyCut& body() const { return *cut_; }
  /// Edges that blades crossed and that stayed whole, so that no crumb came free.
  std::size_t left_whole() const { return left_whole_; }

 private:
  std::unique_ptr<model::BodyCut> cut_;
  std::uint32_t order_ = 0;
  std::size_t left_whole_ = 0;
  std::unique_ptr<mesh::CutSearch> search_;
  std::vector<mesh::CutEdge> room_;
};

/// Fixture for worlds of scenes that are cut.
class OnBackendWithCuts : public OnBackend {
 protected:
  std::unique_ptr<world::World> start_cut(const v1::Scene& scene, const model::SceneCuts& cuts) const {
    auto model = model::compile(scene, backend_->patch_policy(model::requested_cpu_threads(scene)), {}, cuts);
    if (!model) throw std::runtime_error(model.error().message);
    auto world = world::World::create(std::make_unique<model::Model>(std::move(*model)), *backend_);
    if (!world) throw std::runtime_error(world.error().message);
    return std::move(*world);
  }
  /// Returns the world that goes on from another one after a cut.
  std::unique_ptr<world::World> cut_on(const v1::Scene& scene, world::World& before,
                                       const model::SceneCuts& cuts) const {
    std::unique_ptr<world::World> after = start_cut(scene, cuts);
    world::World::Saved saved = before.save();
    auto tissue = world::cut_state(before.model(), saved.tissue, after->model());
    if (!tissue) throw std::runtime_error(tissue.error().message);
    saved.tissue = std::move(*tissue);
    after->take_over(saved);
    return after;
  }
};

}  // namespace tensormass::tests
