#include "world/tool_changes.h"

#include <algorithm>
#include <set>
#include <string>
#include <string_view>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/names.h"

namespace tensormass::world {

namespace {

constexpr std::size_t kRealsOfSlip = 4;  // numbers for a triangle and a contact point, as in NodeState

/// Returns the slips of the next tools' contact points; zero for those of new tools.
std::vector<double> slips_with_tools(const model::Model& present, const model::Model& next,
                                     const std::vector<double>& slips, std::span<const std::size_t> places) {
  std::vector<double> out(sizes_of(next).slips, 0.0);
  if (out.empty() || slips.empty()) return out;
  const std::size_t triangles = next.contact.triangle_count();
  TM_ASSERT(slips.size() == kRealsOfSlip * triangles * present.contact_points(), "slips of this surface");
  for (std::size_t triangle = 0; triangle < triangles; ++triangle) {
    const double* from = slips.data() + kRealsOfSlip * triangle * present.contact_points();
    double* to = out.data() + kRealsOfSlip * triangle * next.contact_points();
    for (std::size_t i = 0; i < places.size(); ++i) {
      if (places[i] == kNewTool) continue;
      const model::ToolModel& tool = next.tools[i];
      std::copy_n(from + kRealsOfSlip * present.tools[places[i]].first_contact_point,
                  kRealsOfSlip * tool.contact_points, to + kRealsOfSlip * tool.first_contact_point);
    }
  }
  return out;
}

/// The same of what blade points remember.
std::vector<double> blades_with_tools(const model::Model& present, const model::Model& next,
                                      const std::vector<double>& points, std::span<const std::size_t> places) {
  const model::Blades &from = present.links.blades, &to = next.links.blades;
  std::vector<double> out(sizes_of(next).blade_points, 0.0);
  for (std::size_t blade = 0, before = 0; blade < to.count(); ++blade) {
    const std::size_t place = places[to.tools[blade]];
    if (place == kNewTool) continue;
    if (blade == 0 || to.tools[blade - 1] != to.tools[blade]) before = 0;  // blades of a tool follow each other
    while (from.tools[before] != place) ++before;
    std::copy(points.begin() + static_cast<std::ptrdiff_t>(kBladeReals * from.first_points[before]),
              points.begin() + static_cast<std::ptrdiff_t>(kBladeReals * from.first_points[before + 1]),
              out.begin() + static_cast<std::ptrdiff_t>(kBladeReals * to.first_points[blade]));
    ++before;
  }
  return out;
}

/// Returns a tool that appears at its initial pose: it has no contact stiffness yet.
World::SavedBesideTissue::Tool appearing(const model::ToolModel& tool) {
  World::SavedBesideTissue::Tool out{ToolMotion(tool).save(), {}, {}, 0};
  out.motion.fade = 0;
  return out;
}

}  // namespace

std::vector<std::size_t> places_before(const model::Model& present, const model::Model& next) {
  std::vector<std::size_t> out;
  for (const model::ToolModel& tool : next.tools) {
    const auto same = std::find_if(present.tools.begin(), present.tools.end(), [&](const model::ToolModel& one) {
      return one.name == tool.name && one.description->SerializeAsString() == tool.description->SerializeAsString();
    });
    out.push_back(same == present.tools.end() ? kNewTool : static_cast<std::size_t>(same - present.tools.begin()));
  }
  return out;
}

bool stay(std::span<const std::size_t> places, std::size_t present_count) {
  if (places.size() != present_count) return false;
  for (std::size_t i = 0; i < places.size(); ++i) {
    if (places[i] != i) return false;
  }
  return true;
}

Result<v1::SceneTools> edited_tools(const google::protobuf::RepeatedPtrField<v1::Tool>& present,
                                    const v1::SceneEdit& edit) {
  if (!edit.ablations().empty() || !edit.severings().empty() || !edit.cuts().empty()) {
    return invalid("edit: adds or removes tools and changes tissue; make two edits of it");
  }
  std::set<std::string_view> gone;
  for (int i = 0; i < edit.remove_tools_size(); ++i) {
    const std::string& name = edit.remove_tools(i);
    const bool known =
        std::any_of(present.begin(), present.end(), [&](const v1::Tool& tool) { return tool.name() == name; });
    if (!known) {
      return fail(ErrorCode::kNotFound,
                  fmt::format("edit.remove_tools[{}]: the scene has no tool '{}'; it has: {}", i, name,
                              list_names(present, [](const v1::Tool& tool) { return tool.name(); })));
    }
    if (!gone.insert(name).second) {
      return invalid(fmt::format("edit.remove_tools[{}]: tool '{}' is named twice; name it once", i, name));
    }
  }
  v1::SceneTools out;
  std::set<std::string_view> taken;
  for (const v1::Tool& tool : present) {
    if (gone.contains(tool.name())) continue;
    *out.add_tools() = tool;
    taken.insert(tool.name());
  }
  for (int i = 0; i < edit.add_tools_size(); ++i) {
    const v1::Tool& tool = edit.add_tools(i);
    if (gone.contains(tool.name())) {
      return invalid(
          fmt::format("edit.add_tools[{}]: the edit removes a tool '{}', too; remove it first, by an edit of its own",
                      i, tool.name()));
    }
    if (!taken.insert(tool.name()).second) {
      return fail(ErrorCode::kAlreadyExists,
                  fmt::format("edit.add_tools[{}]: the scene has a tool '{}' already; take another name, or remove it "
                              "first",
                              i, tool.name()));
    }
    *out.add_tools() = tool;
  }
  return out;
}

World::Saved with_tools(const model::Model& present, const model::Model& next, const World::Saved& saved,
                        std::span<const std::size_t> places) {
  TM_ASSERT(places.size() == next.tools.size(), "a place for each tool");
  World::Saved out = saved;
  out.tissue.slips = slips_with_tools(present, next, saved.tissue.slips, places);
  out.tissue.blade_points = blades_with_tools(present, next, saved.tissue.blade_points, places);
  out.tools.clear();
  for (std::size_t i = 0; i < places.size(); ++i) {
    out.tools.push_back(places[i] == kNewTool ? appearing(next.tools[i]) : saved.tools[places[i]]);
  }
  return out;
}

}  // namespace tensormass::world
