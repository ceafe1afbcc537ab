#include "world/cuts.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "core/cut_limits.h"
#include "core/names.h"
#include "mesh/cut_search.h"
#include "model/progress.h"
#include "model/read_parts.h"
#include "world/hashes.h"

namespace tensormass::world {

namespace {

/// A piece that loses no more than this share of its volume has not lost a piece: a second split of an element moves
/// volume between its parts (docs/decisions/cutting.md).
constexpr double kSamePiece = 1e-3;
/// Smaller shares of a body are crumbs at the edge of a cut, and nobody is told.
constexpr double kCrumb = 1e-5;

using model::BodyCut;
using model::SceneCuts;

/// The bodies of the loaded scene, read when the first of them is cut.
class LoadedBodies {
 public:
  explicit LoadedBodies(const v1::Scene& loaded) : loaded_(loaded) {}

  /// Returns a body without cuts.
  Result<std::unique_ptr<BodyCut>> whole(std::size_t body) {
    if (!bodies_) {
      TM_ASSIGN_OR_RETURN(read, model::read_bodies(loaded_, {}));
      bodies_ = std::move(read);
    }
    return BodyCut::make(bodies_->bodies[body]);
  }
  /// Returns a body with its present cuts, to be cut further.
  Result<std::unique_ptr<BodyCut>> to_be_cut(std::size_t body, const SceneCuts& present) {
    if (present[body] == nullptr) return whole(body);
    return present[body]->copy();
  }

 private:
  const v1::Scene& loaded_;
  std::optional<model::ReadBodies> bodies_;
};

template <class T>
Result<std::vector<T>> read_items(const std::string& bytes, std::string_view where) {
  if (bytes.size() % sizeof(T) != 0) {
    return invalid(fmt::format("{}: {} bytes are not whole numbers of {}", where, bytes.size(), sizeof(T)));
  }
  std::vector<T> out(bytes.size() / sizeof(T));
  if (!out.empty()) std::memcpy(out.data(), bytes.data(), bytes.size());
  return out;
}

/// Cuts as their message has them: what a sender may have made up.
struct ListedCuts {
  std::vector<std::uint32_t> ends, counts, orders;
  std::vector<double> crossings;
};

Result<ListedCuts> read_list(const v1::MeshCuts& message, std::string_view where) {
  ListedCuts out;
  TM_ASSIGN_OR_RETURN(ends, read_items<std::uint32_t>(message.edges(), fmt::format("{}.edges", where)));
  TM_ASSIGN_OR_RETURN(crossings, read_items<double>(message.crossings(), fmt::format("{}.crossings", where)));
  TM_ASSIGN_OR_RETURN(counts, read_items<std::uint32_t>(message.counts(), fmt::format("{}.counts", where)));
  TM_ASSIGN_OR_RETURN(orders, read_items<std::uint32_t>(message.orders(), fmt::format("{}.orders", where)));
  std::uint64_t edges = 0;
  for (const std::uint32_t count : counts) edges += count;
  if (ends.size() != 2 * edges || crossings.size() != edges || orders.size() != counts.size()) {
    return invalid(fmt::format("{}: {} ends, {} crossings and {} orders do not fit {} cuts of {} edges", where,
                               ends.size(), crossings.size(), orders.size(), counts.size(), edges));
  }
  if (counts.size() > limits::kMaxCutsOfBody) {
    return fail(ErrorCode::kResourceExhausted, fmt::format("{}: {} cuts, more than limits::kMaxCutsOfBody = {}", where,
                                                           counts.size(), limits::kMaxCutsOfBody));
  }
  if (std::adjacent_find(orders.begin(), orders.end(), std::greater_equal<>()) != orders.end()) {
    return invalid(fmt::format("{}.orders: they do not ascend", where));
  }
  return ListedCuts{std::move(ends), std::move(counts), std::move(orders), std::move(crossings)};
}

Result<std::vector<mesh::CutEdge>> edges_of(const mesh::CutTopology& topology, const ListedCuts& list,
                                            std::size_t first, std::size_t count, std::string_view where) {
  std::vector<mesh::CutEdge> out;
  for (std::size_t i = first; i < first + count; ++i) {
    const std::uint32_t a = list.ends[2 * i], b = list.ends[2 * i + 1];
    const bool are_nodes = a < b && b < topology.node_count();
    const std::uint32_t edge = are_nodes ? topology.edge_between(a, b) : mesh::kNone;
    if (edge == mesh::kNone) return invalid(fmt::format("{}.edges[{}]: no edge from node {} to {}", where, i, a, b));
    if (!(list.crossings[i] >= 0 && list.crossings[i] <= 1)) {
      return invalid(fmt::format("{}.crossings[{}]: {} is not from 0 to 1", where, i, list.crossings[i]));
    }
    out.push_back({edge, list.crossings[i]});
  }
  return out;
}

tl::unexpected<Error> refuse_to_take_back() {
  return fail(ErrorCode::kFailedPrecondition,
              "changes.bodies.cuts: the scene has cuts that are not among these; reset it first, which heals them");
}

/// Returns the cuts of a body. present: those that it has now, with which the message must begin; nullptr: none
Result<std::shared_ptr<const BodyCut>> read_body(const v1::MeshCuts& message, std::size_t body,
                                                 const std::shared_ptr<const BodyCut>& present, LoadedBodies& loaded,
                                                 std::string_view where) {
  TM_ASSIGN_OR_RETURN(list, read_list(message, where));
  if (list.counts.empty() && present == nullptr) return present;
  std::unique_ptr<BodyCut> out;
  if (present == nullptr) {
    TM_ASSIGN_OR_RETURN(whole, loaded.whole(body));
    out = std::move(whole);
  }
  const mesh::CutTopology& topology = present == nullptr ? out->topology() : present->topology();
  std::vector<model::CutBatch> batches;
  std::size_t first = 0;
  for (std::size_t cut = 0; cut < list.counts.size(); first += list.counts[cut++]) {
    TM_ASSIGN_OR_RETURN(edges, edges_of(topology, list, first, list.counts[cut], where));
    batches.push_back({list.orders[cut], std::move(edges)});
  }
  if (present != nullptr) {
    const auto same = [](const model::CutBatch& a, const model::CutBatch& b) {
      return a.order == b.order && std::ranges::equal(a.edges, b.edges, [](const auto& x, const auto& y) {
               return x.edge == y.edge && x.crossing == y.crossing;
             });
    };
    const std::vector<model::CutBatch>& made = present->batches();
    if (made.size() > batches.size() || !std::equal(made.begin(), made.end(), batches.begin(), same)) {
      return refuse_to_take_back();
    }
    if (made.size() == batches.size()) return present;
    out = present->copy();
  }
  for (std::size_t cut = out->batches().size(); cut < batches.size(); ++cut) {
    if (auto made = out->make_cut(batches[cut].order, std::move(batches[cut].edges)); !made) {
      return fail(made.error().code, fmt::format("{}: {}", where, made.error().message));
    }
  }
  return std::shared_ptr<const BodyCut>(std::move(out));
}

/// The edges of a body that blades cross and that are whole, each once.
class CrossedEdges {
 public:
  explicit CrossedEdges(const BodyCut& body)
      : body_(body), search_(body.topology()), room_(body.topology().edge_count()), met_(room_.size(), false) {}

  Result<void> add(const std::vector<Eigen::Vector3d>& before, const std::vector<Eigen::Vector3d>& after,
                   std::string_view where) {
    const mesh::Sweep sweep = search_.sweep(before, after, room_);
    if (sweep.refused) return invalid(fmt::format("{}: {}", where, words(sweep.refusal)));
    for (const mesh::CutEdge& edge : sweep.edges) {
      if (met_[edge.edge] || body_.cut().is_cut(edge.edge)) continue;
      met_[edge.edge] = true;
      edges_.push_back(edge);
    }
    return {};
  }
  const std::vector<mesh::CutEdge>& edges() const { return edges_; }
  Result<std::vector<mesh::CutEdge>> take(std::string_view where) {
    if (edges_.size() > limits::kMaxEdgesOfCut) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("{}: it crosses {} edges, more than limits::kMaxEdgesOfCut = {}; make several cuts",
                              where, edges_.size(), limits::kMaxEdgesOfCut));
    }
    return std::move(edges_);
  }

 private:
  const BodyCut& body_;
  mesh::CutSearch search_;
  std::vector<mesh::CutEdge> room_, edges_;
  std::vector<bool> met_;
};

/// Returns the edges that a blade crosses on its way, each once.
Result<std::vector<mesh::CutEdge>> crossed_edges(const BodyCut& body, const v1::Cut& cut, std::string_view where) {
  const auto positions = static_cast<std::size_t>(cut.blade_size());
  if (positions < 2 || positions > limits::kMaxBladePositions) {
    return invalid(fmt::format("{}.blade: {} positions; give 2 to limits::kMaxBladePositions = {}", where, positions,
                               limits::kMaxBladePositions));
  }
  std::vector<std::vector<Eigen::Vector3d>> blade;
  for (int i = 0; i < cut.blade_size(); ++i) {
    const auto& numbers = cut.blade(i).points_m();
    const auto points = static_cast<std::size_t>(numbers.size()) / 3;
    if (numbers.size() % 3 != 0 || points < 2 || points > limits::kMaxBladePoints) {
      return invalid(
          fmt::format("{}.blade[{}].points_m: {} numbers; give 3 for each of 2 to limits::kMaxBladePoints = "
                      "{} points",
                      where, i, numbers.size(), limits::kMaxBladePoints));
    }
    if (i > 0 && points != blade.front().size()) {
      return invalid(fmt::format("{}.blade[{}].points_m: {} points, and {} before; a blade keeps its points", where, i,
                                 points, blade.front().size()));
    }
    std::vector<Eigen::Vector3d>& at = blade.emplace_back();
    for (std::size_t p = 0; p < points; ++p) {
      const int first = static_cast<int>(3 * p);
      at.emplace_back(numbers[first], numbers[first + 1], numbers[first + 2]);
    }
  }
  CrossedEdges crossed(body);
  for (std::size_t i = 1; i < blade.size(); ++i) {
    TM_RETURN_IF_ERROR(crossed.add(blade[i - 1], blade[i], fmt::format("{}.blade[{}]", where, i)));
  }
  if (crossed.edges().empty()) {
    return invalid(
        fmt::format("{}.blade: it crosses no edge of body '{}' that is whole; give its positions where the "
                    "body's mesh is at rest",
                    where, cut.body()));
  }
  return crossed.take(fmt::format("{}.blade", where));
}

template <class T>
void append_bytes(const T& value, std::string& out) {
  out.append(reinterpret_cast<const char*>(&value), sizeof(value));
}

std::uint32_t next_order(const SceneCuts& cuts) {
  std::uint32_t last = 0;
  for (const auto& body : cuts) {
    if (body != nullptr) last = std::max(last, body->batches().back().order);
  }
  return last + 1;
}

/// Makes the next cut of a scene in one of its bodies. Returns false, and cuts nothing, if it would only free crumbs.
/// body: a copy of cuts[b], or the whole body
Result<bool> add_cut(SceneCuts& cuts, std::size_t b, std::unique_ptr<BodyCut> body, std::vector<mesh::CutEdge> edges,
                     std::string_view where) {
  edges = body->without_crumbs(std::move(edges));
  if (edges.empty()) return false;
  if (auto made = body->make_cut(next_order(cuts), std::move(edges)); !made) {
    return fail(made.error().code, fmt::format("{}: {}", where, made.error().message));
  }
  cuts[b] = std::move(body);
  return true;
}

}  // namespace

Result<SceneCuts> read_cuts(const v1::Scene& loaded, const v1::SceneAdjustments& wanted, const SceneCuts& present) {
  SceneCuts out(static_cast<std::size_t>(loaded.bodies_size()));
  LoadedBodies bodies(loaded);
  std::vector<std::uint32_t> orders;
  bool comes_before = false;  // a new cut has its place before one that was made
  for (std::size_t b = 0; b < out.size(); ++b) {
    const v1::BodyAdjustment& body = wanted.bodies(static_cast<int>(b));
    const auto before = present.empty() ? nullptr : present[b];
    TM_ASSIGN_OR_RETURN(
        cuts, read_body(body.cuts(), b, before, bodies, fmt::format("changes.bodies ('{}').cuts", body.body())));
    if (cuts == nullptr) continue;
    const std::size_t made = before == nullptr ? 0 : before->batches().size();
    for (std::size_t cut = 0; cut < cuts->batches().size(); ++cut) {
      orders.push_back(cuts->batches()[cut].order);
      comes_before = comes_before || (cut >= made && orders.back() < next_order(present));
    }
    out[b] = std::move(cuts);
  }
  std::sort(orders.begin(), orders.end());
  if (std::adjacent_find(orders.begin(), orders.end()) != orders.end()) {
    return invalid("changes.bodies.cuts.orders: two cuts have the same place among those of the scene");
  }
  if (comes_before) return refuse_to_take_back();
  if (orders.empty()) return SceneCuts();
  if (!loaded.editing().has_cutting()) {
    return fail(ErrorCode::kFailedPrecondition, "the scene has no room for cuts; load it with scene.editing.cutting");
  }
  return out;
}

std::uint64_t hash_of_cut(std::uint64_t scene_hash, const v1::SceneAdjustments& adjustments) {
  Hash hash;
  hash.add(scene_hash);
  for (const v1::BodyAdjustment& body : adjustments.bodies()) {
    const v1::MeshCuts& cuts = body.cuts();
    for (const std::string* bytes : {&cuts.edges(), &cuts.crossings(), &cuts.counts(), &cuts.orders()})
      hash.add(*bytes);
  }
  return hash.value();
}

void write_cuts(const SceneCuts& cuts, v1::SceneAdjustments& adjustments) {
  for (int b = 0; b < adjustments.bodies_size(); ++b) {
    v1::MeshCuts& out = *adjustments.mutable_bodies(b)->mutable_cuts();
    out.Clear();
    if (cuts.empty() || cuts[static_cast<std::size_t>(b)] == nullptr) continue;
    const BodyCut& body = *cuts[static_cast<std::size_t>(b)];
    for (const model::CutBatch& batch : body.batches()) {
      append_bytes(static_cast<std::uint32_t>(batch.edges.size()), *out.mutable_counts());
      append_bytes(batch.order, *out.mutable_orders());
      for (const mesh::CutEdge& edge : batch.edges) {
        for (const std::uint32_t end : body.topology().ends(edge.edge)) append_bytes(end, *out.mutable_edges());
        append_bytes(edge.crossing, *out.mutable_crossings());
      }
    }
  }
}

Result<SceneCuts> cut_edges(const v1::Scene& loaded, const v1::SceneEdit& edit, const SceneCuts& present) {
  if (!edit.ablations().empty() || !edit.severings().empty()) {
    return invalid("edit: cuts are alone in their edit; make two edits");
  }
  if (!loaded.editing().has_cutting()) {
    return fail(ErrorCode::kFailedPrecondition,
                "edit.cuts: the scene has no room for cuts; load it with scene.editing.cutting");
  }
  SceneCuts out = present;
  out.resize(static_cast<std::size_t>(loaded.bodies_size()));
  LoadedBodies bodies(loaded);
  for (int i = 0; i < edit.cuts_size(); ++i) {
    const v1::Cut& cut = edit.cuts(i);
    const std::string where = fmt::format("edit.cuts[{}]", i);
    const auto found = std::find_if(loaded.bodies().begin(), loaded.bodies().end(),
                                    [&](const v1::Body& body) { return body.name() == cut.body(); });
    if (found == loaded.bodies().end()) {
      return fail(ErrorCode::kNotFound,
                  fmt::format("{}.body: the scene has no body '{}'; it has: {}", where, cut.body(),
                              list_names(loaded.bodies(), [](const v1::Body& body) { return body.name(); })));
    }
    const auto b = static_cast<std::size_t>(found - loaded.bodies().begin());
    TM_ASSIGN_OR_RETURN(body, bodies.to_be_cut(b, out));
    TM_ASSIGN_OR_RETURN(edges, crossed_edges(*body, cut, where));
    TM_ASSIGN_OR_RETURN(is_cut, add_cut(out, b, std::move(body), std::move(edges), where));
    if (!is_cut) {
      return invalid(
          fmt::format("{}.blade: it would only free crumbs of body '{}', pieces smaller than half an element; "
                      "cut farther from where the body is cut already",
                      where, cut.body()));
    }
  }
  return out;
}

Result<SceneCuts> cut_along(const v1::Scene& loaded, std::span<const SweptWay> ways, const SceneCuts& present) {
  SceneCuts out = present;
  out.resize(static_cast<std::size_t>(loaded.bodies_size()));
  LoadedBodies bodies(loaded);
  bool any = false;
  for (std::size_t b = 0; b < out.size(); ++b) {
    if (std::none_of(ways.begin(), ways.end(), [&](const SweptWay& way) { return way.body == b; })) continue;
    const std::string where = fmt::format("body '{}'", loaded.bodies(static_cast<int>(b)).name());
    TM_ASSIGN_OR_RETURN(body, bodies.to_be_cut(b, out));
    CrossedEdges crossed(*body);
    for (const SweptWay& way : ways) {
      for (std::size_t i = 1; way.body == b && i < way.positions_m.size(); ++i) {
        TM_RETURN_IF_ERROR(crossed.add(way.positions_m[i - 1], way.positions_m[i], where));
      }
    }
    if (crossed.edges().empty()) continue;
    TM_ASSIGN_OR_RETURN(edges, crossed.take(where));
    TM_ASSIGN_OR_RETURN(is_cut, add_cut(out, b, std::move(body), std::move(edges), where));
    any = any || is_cut;
  }
  return any ? std::move(out) : SceneCuts(present);
}

std::vector<FreedPiece> freed_pieces(const SceneCuts& before, const SceneCuts& after) {
  std::vector<FreedPiece> out;
  for (std::size_t b = 0; b < after.size(); ++b) {
    if (after[b] == nullptr || (!before.empty() && before[b] == after[b])) continue;
    const std::span<const mesh::CutPiece> now = after[b]->pieces();
    const std::span<const mesh::CutPiece> old =
        before.empty() || before[b] == nullptr ? after[b]->whole_pieces() : before[b]->pieces();
    if (now.size() <= old.size()) continue;
    // Rows of a piece that splits go to its parts, so its lowest row stays with one of them: perhaps the smaller one.
    std::vector<double> changed_m3;
    double body_m3 = 0;
    for (const mesh::CutPiece& piece : now) {
      body_m3 += piece.volume_m3;
      const auto same = std::find_if(old.begin(), old.end(), [&](const auto& one) { return one.row == piece.row; });
      const bool stays = same != old.end() && piece.volume_m3 > (1 - kSamePiece) * same->volume_m3;
      if (!stays) changed_m3.push_back(piece.volume_m3);
    }
    std::sort(changed_m3.begin(), changed_m3.end());
    changed_m3.resize(std::min(changed_m3.size(), now.size() - old.size()));
    for (const double volume_m3 : changed_m3) {
      if (volume_m3 > kCrumb * body_m3) out.push_back({static_cast<std::uint32_t>(b), volume_m3});
    }
  }
  return out;
}

double area_of(const SceneCuts& cuts) {
  double sum = 0;
  for (const auto& body : cuts) sum += body == nullptr ? 0 : body->area_m2();
  return sum;
}

std::shared_ptr<SurfaceChanges> changes_of(const model::Model& model, const SceneCuts& cuts) {
  auto out = std::make_shared<SurfaceChanges>();
  out->appended_vertex_count = model.visible.appended_count;
  out->bodies.resize(model.bodies.size());
  const std::vector<std::vector<std::uint32_t>> places = model::places_of_appended(cuts);
  for (std::size_t b = 0; b < cuts.size(); ++b) {
    if (cuts[b] == nullptr) continue;
    const mesh::CutChanges& changes = cuts[b]->changes();
    BodyChanges& body = out->bodies[b];
    body.dead_triangles = changes.dead_triangles();
    // Frame.positions has the ends of springs apart.
    for (const std::uint32_t place : places[b]) body.appended_vertices.push_back(model.visible.vertex_count + place);
    body.appended_triangles = changes.appended_triangles();
    body.appended_kinds = changes.appended_is_cut();  // v1::BodyChanges::Face: 1 is a cut face
  }
  return out;
}

}  // namespace tensormass::world
