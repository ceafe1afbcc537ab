#include "world/hashes.h"

#include "tensormass/v1/scene.pb.h"

#include <cstring>
#include <vector>

namespace tensormass::world {

void Hash::add(std::string_view bytes) {
  add(std::uint64_t{bytes.size()});
  while (!bytes.empty()) {
    std::uint64_t word = 0;
    const std::size_t count = std::min(bytes.size(), sizeof(word));
    std::memcpy(&word, bytes.data(), count);
    add(word);
    bytes.remove_prefix(count);
  }
}

std::uint64_t hash_of(const v1::Scene& scene) {
  Hash hash;
  // Part by part, because a copy of all meshes would double the memory of a load. No message has a map, so equal
  // messages have equal bytes.
  const auto add = [&hash](const google::protobuf::MessageLite& part) { hash.add(part.SerializeAsString()); };
  const google::protobuf::Reflection& reflection = *scene.GetReflection();
  std::vector<const google::protobuf::FieldDescriptor*> given;
  reflection.ListFields(scene, &given);
  for (const google::protobuf::FieldDescriptor* field : given) {
    switch (field->number()) {
      case v1::Scene::kNameFieldNumber:
      case v1::Scene::kStreamsFieldNumber:
      case v1::Scene::kAcceptedFindingsFieldNumber:
      case v1::Scene::kSteppingFieldNumber:
      case v1::Scene::kSolverFieldNumber:
        continue;  // the first three do not matter, the others follow
      default:
        break;
    }
    hash.add(std::uint64_t{static_cast<std::uint32_t>(field->number())});
    if (!field->is_repeated()) {
      add(reflection.GetMessage(scene, field));
      continue;
    }
    hash.add(std::uint64_t{static_cast<std::uint32_t>(reflection.FieldSize(scene, field))});
    for (int i = 0; i < reflection.FieldSize(scene, field); ++i) add(reflection.GetRepeatedMessage(scene, field, i));
  }
  v1::Stepping stepping = scene.stepping();
  stepping.clear_rate_hz();
  stepping.clear_lockstep();
  add(stepping);
  v1::Solver solver = scene.solver();
  solver.clear_cpu_threads();
  solver.clear_budget_s();
  add(solver);
  return hash.value();
}

std::uint64_t hash_of_layout(const model::Model& model) {
  const matrix::Layout& layout = model.layout;
  Hash hash;
  hash.add(std::uint64_t{model.double_precision});
  hash.add(std::uint64_t{layout.patch_count});
  hash.add(std::uint64_t{layout.row_count});
  for (const std::uint32_t row : layout.row_of_node) hash.add(std::uint64_t{row});
  return hash.value();
}

std::uint64_t hash_of(const backend::RowState& state, std::span<const std::uint32_t> row_of_node) {
  Hash hash;
  for (const std::uint32_t row : row_of_node) {
    for (std::size_t c = 0; c < 3; ++c) {
      hash.add(state.displacement[4 * std::size_t{row} + c]);
      hash.add(state.velocity[4 * std::size_t{row} + c]);
    }
  }
  for (const double variable : state.internal_variables) hash.add(variable);
  return hash.value();
}

}  // namespace tensormass::world
