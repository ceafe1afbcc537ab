#pragma once

#include <functional>
#include <limits>
#include <ostream>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/scenes.h"

/// Scenes that are refused: what is wrong with each, and what the refusal says.
namespace tensormass::model {

inline const double kNan = std::numeric_limits<double>::quiet_NaN();
inline const double kInfinity = std::numeric_limits<double>::infinity();

struct Refusal {
  std::string name;
  std::function<void(v1::Scene&)> spoil;
  std::vector<std::string> says;  ///< parts of the message; the first is the place
  ErrorCode code = ErrorCode::kInvalidArgument;

  friend void PrintTo(const Refusal& refusal, std::ostream* out) { *out << refusal.name; }
};

/// The scene that a refusal spoils.
inline v1::Scene admitted_scene() { return tests::block_with_probe(false, 4); }

inline void expect_refused(const Refusal& refusal) {
  v1::Scene scene = admitted_scene();
  refusal.spoil(scene);
  const auto model = compile(scene, {});
  ASSERT_FALSE(model) << "it was admitted";
  EXPECT_EQ(model.error().code, refusal.code);
  for (const std::string& part : refusal.says) {
    EXPECT_NE(model.error().message.find(part), std::string::npos)
        << "missing '" << part << "' in: " << model.error().message;
  }
}

}  // namespace tensormass::model
