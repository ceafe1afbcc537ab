#include "model/progress.h"

namespace tensormass::model {

namespace {

struct PartText {
  const char* name;
  double begin;  // fraction of the load at its start
  double each;   // fraction of all bodies together, for a part that comes once a body; 0: it comes once
};

/// Fractions as measured with 1,019,520 tetrahedra on two cores (docs/performance.md).
PartText text(LoadPart part) {
  constexpr double kBodies = 0.35;  // bodies are read and checked one after the other
  switch (part) {
    case LoadPart::kReadMesh:
      return {"reading the mesh", 0, kBodies};
    case LoadPart::kCheckMesh:
      return {"checking the mesh", 0.05, kBodies};
    case LoadPart::kOrderNodes:
      return {"ordering nodes", kBodies, 0};
    case LoadPart::kBoundaryConditions:
      return {"boundary conditions", 0.5, 0};
    case LoadPart::kElements:
      return {"elements", 0.55, 0};
    case LoadPart::kSurfaces:
      return {"surfaces", 0.85, 0};
    case LoadPart::kBuffers:
      return {"buffers", 0.9, 0};
  }
  return {"", 0, 0};
}

}  // namespace

Result<void> Progress::begin(LoadPart part, std::size_t done, std::size_t count) const {
  if (!listener_) return {};
  const PartText of = text(part);
  const double bodies = static_cast<double>(done) / static_cast<double>(count);
  const double fraction = of.each > 0 ? of.each * bodies + of.begin / static_cast<double>(count) : of.begin;
  if (listener_(of.name, fraction)) return {};
  return fail(ErrorCode::kCancelled, "the client gave up; the scene was not loaded");
}

}  // namespace tensormass::model
