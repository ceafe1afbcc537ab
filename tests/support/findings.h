#pragma once

#include <string>
#include <vector>

#include "core/findings.h"

namespace tensormass::tests {

/// Returns the texts of the findings of a kind.
inline std::vector<std::string> texts(const std::vector<Finding>& findings, FindingCode code) {
  std::vector<std::string> out;
  for (const Finding& finding : findings) {
    if (finding.code == code) out.push_back(finding.text());
  }
  return out;
}

}  // namespace tensormass::tests
