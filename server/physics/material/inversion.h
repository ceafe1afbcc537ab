#pragma once

namespace tensormass::physics {

/// What a law promises for an element that is pressed flat or turned inside out.
enum class Inversion {
  kRecovers,    ///< forces lead back from any F; the step goes on
  kCaught,      ///< its forces lead away from rest or are none: no step that ends with det F ≤ 0 is published
  kOutOfRange,  ///< linear: does not notice it, and has left its range long before, which the status says
};

}  // namespace tensormass::physics
