#pragma once

#include <cmath>

namespace tensormass::haptic {

inline bool is_positive(double value) { return std::isfinite(value) && value > 0.0; }
inline bool is_not_negative(double value) { return std::isfinite(value) && value >= 0.0; }

}  // namespace tensormass::haptic
