#include "world/surface_changes.h"

#include <algorithm>

#include "core/assert.h"

namespace tensormass::world {

namespace {
/// Triangles and vertices that changes have room for from the start.
constexpr std::size_t kUsual = std::size_t{1} << 16;
}  // namespace

SurfaceChangesMaker::SurfaceChangesMaker(const model::Model& model) {
  if (!model.edit_tables) return;
  const model::EditTables& tables = *model.edit_tables;
  for (auto& kept : kept_) {
    kept = std::make_shared<SurfaceChanges>();
    kept->bodies.resize(model.bodies.size());
    for (std::size_t b = 0; b < model.bodies.size(); ++b) {
      BodyChanges& body = kept->bodies[b];
      const std::size_t triangles = std::min<std::size_t>(tables.max_new_triangles, kUsual);
      body.dead_triangles.reserve(std::min(model.bodies[b].triangles.size() + triangles, kUsual));
      body.appended_vertices.reserve(std::min<std::size_t>(tables.max_new_vertices, kUsual));
      body.appended_triangles.reserve(triangles);
      body.appended_kinds.reserve(triangles);
      body.coagulation.reserve(model.bodies[b].vertex_count + std::min<std::size_t>(tables.max_new_vertices, kUsual));
    }
  }
}

SurfaceChangesPointer SurfaceChangesMaker::take(const model::Model& model, const model::Editor& editor) {
  if (model.visible.count() == 0) return nullptr;
  // A surface without an edit has the revision 0, also in a world that takes the place of another one.
  if (editor.surface_revision() == (editor_ == &editor ? taken_ : 0) && (editor_ == &editor || revision_ == 0)) {
    return nullptr;
  }
  editor_ = &editor;
  taken_ = editor.surface_revision();
  const auto free = std::find_if(kept_.begin(), kept_.end(), [](const auto& kept) { return kept.use_count() == 1; });
  TM_ASSERT(free != kept_.end(), "readers hold fewer changes than are kept");
  SurfaceChanges& changes = **free;
  changes.revision = ++revision_;
  changes.appended_vertex_count = model.visible.appended_count;
  const std::span<const model::BodySurface> surfaces = editor.surfaces();
  for (std::size_t b = 0; b < surfaces.size(); ++b) {
    BodyChanges& body = changes.bodies[b];
    body.dead_triangles = surfaces[b].dead_triangles;
    body.appended_vertices = surfaces[b].appended_vertices;
    // A frame has the ends of springs apart from its vertices.
    for (std::uint32_t& vertex : body.appended_vertices) vertex -= model.visible.attachment_point_count();
    body.appended_triangles = surfaces[b].appended_triangles;
    body.coagulation = surfaces[b].coagulation;
    // Vertices that were appended since then are raw.
    if (!body.coagulation.empty()) {
      body.coagulation.resize(model.bodies[b].vertex_count + body.appended_vertices.size(), 0);
    }
    body.appended_kinds.resize(surfaces[b].appended_kinds.size());
    std::transform(surfaces[b].appended_kinds.begin(), surfaces[b].appended_kinds.end(), body.appended_kinds.begin(),
                   [](model::Face kind) { return static_cast<std::uint8_t>(kind); });
  }
  return *free;
}

}  // namespace tensormass::world
