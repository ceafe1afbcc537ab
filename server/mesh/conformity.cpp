#include "mesh/conformity.h"

#include <algorithm>
#include <set>
#include <tuple>

#include <fmt/ranges.h>

#include "mesh/faces.h"

namespace tensormass::mesh {
namespace {

/// Returns whether two faces with the same corners are the same face seen from its two sides, including mid-edge nodes.
bool mirrored(const FaceNodes& a, const FaceNodes& b, std::uint32_t corners) {
  if (a.count != b.count) return false;
  const auto start = static_cast<std::uint32_t>(std::find(b.begin(), b.begin() + corners, a[0]) - b.begin());
  const auto back = [&](std::uint32_t steps) { return (start + 2 * corners - steps) % corners; };
  for (std::uint32_t i = 0; i < corners; ++i) {
    if (a[i] != b[back(i)]) return false;
    // Side i of `a`, from corner i to i + 1, is the side of `b` that ends in corner back(i).
    if (a.count > corners && a[corners + i] != b[corners + back(i + 1)]) return false;
  }
  return true;
}

/// Three nodes of a boundary face, as the key to find other faces that lie on it: two boundary faces with a common key
/// overlap without being one face.
struct Part {
  std::array<std::uint32_t, 3> key;  // ascending
  ElementFace face;
};

/// Runs the two checks while it is made.
class Check {
 public:
  Check(const Mesh& mesh, std::string_view body) : body_(body), nodes_of_(element_nodes(mesh)) {
    shapes_.reserve(nodes_of_.size());
    for_each_element(mesh, [&](std::uint32_t, const Topology& shape, auto) { shapes_.push_back(&shape); });
    match_faces(mesh, [&](std::span<const ElementFace> same) { check_same_corners(same); });
    check_boundary();
  }

  Conformity result() && { return std::move(result_); }

 private:
  const Face& local(const ElementFace& face) const { return shapes_[face.element]->faces[face.face]; }
  FaceNodes nodes(const ElementFace& face) const { return face_nodes(local(face), nodes_of_[face.element]); }

  /// Checks the faces with the same corners: one is on the boundary, two must mirror each other, more overlap.
  void check_same_corners(std::span<const ElementFace> same) {
    if (same.size() == 1) {
      boundary_.push_back(same[0]);
      return;
    }
    const FaceNodes a = nodes(same[0]), b = nodes(same[1]);
    if (same.size() > 2) {
      result_.overlapping.add([&] {
        return fmt::format("the face ({}) of body '{}' belongs to {} elements, among them {}, {} and {}",
                           fmt::join(a, ", "), body_, same.size(), same[0].element, same[1].element, same[2].element);
      });
    } else if (mirrored(a, b, local(same[0]).corner_count())) {
      return;
    } else if (std::is_permutation(a.begin(), a.end(), b.begin(), b.end())) {
      result_.overlapping.add([&] {
        return fmt::format("elements {} and {} of body '{}' lie on the same side of their face ({})", same[0].element,
                           same[1].element, body_, fmt::join(a, ", "));
      });
    } else {
      add_nonconforming(same[0], same[1]);
    }
  }

  /// Finds boundary faces that share three nodes with another boundary face, such as a triangle on a quadrilateral.
  void check_boundary() {
    // Linear triangles on each other have the same corners, so check_same_corners has met them.
    const auto compound = [&](const ElementFace& face) { return local(face).node_count > 3; };
    if (std::none_of(boundary_.begin(), boundary_.end(), compound)) return;
    std::vector<Part> parts;
    for (const ElementFace& face : boundary_) {
      const FaceNodes n = nodes(face);
      const auto add = [&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
        Part& part = parts.emplace_back(Part{{n[i], n[j], n[k]}, face});
        std::sort(part.key.begin(), part.key.end());
      };
      add(0, 1, 2);
      if (local(face).corner_count() == 4) {
        add(0, 1, 3);
        add(0, 2, 3);
        add(1, 2, 3);
      }
      if (local(face).is_quadratic()) {
        for (const auto& [i, j, k] : quadratic_face_triangles(n.count)) add(i, j, k);
      }
    }
    std::sort(parts.begin(), parts.end(), [](const Part& a, const Part& b) {
      return std::tie(a.key, a.face.element) < std::tie(b.key, b.face.element);
    });
    std::set<std::pair<std::uint32_t, std::uint32_t>>
        found;  // pairs already reported: two quadrilaterals may share several keys
    for (std::size_t i = 1; i < parts.size(); ++i) {
      const ElementFace &a = parts[i - 1].face, &b = parts[i].face;
      if (parts[i - 1].key == parts[i].key && found.emplace(a.element, b.element).second) add_nonconforming(a, b);
    }
  }

  void add_nonconforming(const ElementFace& a, const ElementFace& b) {
    result_.nonconforming.add([&] {
      const auto name = [&](const ElementFace& face) {
        return fmt::format("element {} ({}, face {})", face.element, shapes_[face.element]->name,
                           fmt::join(nodes(face), " "));
      };
      return fmt::format("{} and {} of body '{}' meet without sharing a face", name(a), name(b), body_);
    });
  }

  std::string_view body_;
  std::vector<std::span<const std::uint32_t>> nodes_of_;
  std::vector<const Topology*> shapes_;
  std::vector<ElementFace> boundary_;
  Conformity result_;
};

}  // namespace

Conformity check_conformity(const Mesh& mesh, std::string_view body) { return Check(mesh, body).result(); }

}  // namespace tensormass::mesh
