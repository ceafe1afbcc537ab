// Times edits of a mesh that is being cut: a blade moves through a block in small steps.
//
//   tensormass-bench-cuts [CELLS] [STEPS]    cells along a side (28: 131,712 tetrahedra), steps of the way (960)
//
// Prints for each shape that has physics for cuts, and for the steps that cut something: median, 99th percentile and
// longest time of finding the edges and of the edit.

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include <fmt/format.h>

#include "mesh/cut.h"
#include "mesh/grid.h"

namespace {

using namespace tensormass::mesh;
using Clock = std::chrono::steady_clock;

void print(const char* what, std::vector<double>& times_us) {
  if (times_us.empty()) return;
  std::sort(times_us.begin(), times_us.end());
  const auto at = [&](double part) {
    return times_us[static_cast<std::size_t>(part * static_cast<double>(times_us.size() - 1))];
  };
  fmt::print("  {:<18} median {:8.1f} us   p99 {:8.1f} us   longest {:8.1f} us\n", what, at(0.5), at(0.99), at(1.0));
}

void measure(Shape shape, std::uint32_t cells, int steps) {
  const Mesh mesh = make_grid({0.0, 0.0, 0.0}, {0.1, 0.1, 0.1}, cells, cells, cells, shape).value();
  const CutTopology topology(mesh);
  CutSearch search(topology);
  Cut cut(topology, {element_count(mesh), topology.node_count()});
  std::vector<CutEdge> room(topology.edge_count());
  std::vector<CutPiece> pieces(16);
  // A blade of eight points, 30 mm deep and askew to the grid, goes 60 mm.
  const auto blade = [&](double s) {
    std::vector<Eigen::Vector3d> points;
    for (int i = 0; i < 8; ++i) {
      const double depth = i / 7.0;
      points.push_back({0.02 + 0.06 * s + 0.011 * depth, 0.1003 - 0.03 * depth, 0.0511 + 0.023 * s + 0.005 * depth});
    }
    return points;
  };
  std::vector<double> search_us, edit_us, edges;
  for (int step = 0; step < steps; ++step) {
    const auto before = blade(static_cast<double>(step) / steps), after = blade(static_cast<double>(step + 1) / steps);
    const auto start = Clock::now();
    const Sweep sweep = search.sweep(before, after, room);
    const auto found = Clock::now();
    const CutChange change = cut.cut(sweep.edges);
    const auto end = Clock::now();
    if (change.edges.empty()) continue;
    search_us.push_back(std::chrono::duration<double, std::micro>(found - start).count());
    edit_us.push_back(std::chrono::duration<double, std::micro>(end - found).count());
    edges.push_back(static_cast<double>(change.edges.size()));
  }
  const auto start = Clock::now();
  const std::size_t count = cut.pieces(pieces);
  const double pieces_us = std::chrono::duration<double, std::micro>(Clock::now() - start).count();
  double sum = 0.0;
  for (const double n : edges) sum += n;
  fmt::print("{}: {} elements, {} steps of {} cut {} edges, {} parts, {} virtual nodes, {} pieces\n",
             tensormass::mesh::topology(shape).name, element_count(mesh), edges.size(), steps, sum, cut.parts().size(),
             cut.virtual_nodes().size(), count);
  print("edges of a sweep", search_us);
  print("edit", edit_us);
  fmt::print("  pieces of the mesh {:8.1f} us\n", pieces_us);
}

}  // namespace

int main(int argc, char** argv) {
  const int cells = argc > 1 ? std::atoi(argv[1]) : 28, steps = argc > 2 ? std::atoi(argv[2]) : 960;
  if (cells < 1 || steps < 1) {
    fmt::print(stderr, "tensormass-bench-cuts: CELLS and STEPS are numbers from 1\n");
    return 2;
  }
  measure(Shape::kTetrahedron, static_cast<std::uint32_t>(cells), steps);
  measure(Shape::kHexahedron, static_cast<std::uint32_t>(cells), steps);
}
