#pragma once

namespace tensormass::physics {

/// What a law promises for an element that is collapsed or inverted.
enum class Inversion {
  kRecovers,    ///< forces lead back from any F; the step goes on
  kCaught,      ///< forces lead away from rest, vanish or are NaN; a step that ends with det F ≤ 0 is not published
  kOutOfRange,  ///< linear: does not detect inversion, and has left its range long before, which the status reports
};

}  // namespace tensormass::physics
