#include "model/model.h"

#include <algorithm>

namespace tensormass::model {

Vec3<double> Prescribed::at(double time) const {
  if (time_s.empty()) return displacement_m;
  const auto after = std::upper_bound(time_s.begin(), time_s.end(), time);
  if (after == time_s.begin()) return displacement_m * factor.front();
  if (after == time_s.end()) return displacement_m * factor.back();
  const std::size_t i = static_cast<std::size_t>(after - time_s.begin());
  const double share = (time - time_s[i - 1]) / (time_s[i] - time_s[i - 1]);
  return displacement_m * (factor[i - 1] + share * (factor[i] - factor[i - 1]));
}

tensor::StepScheme<double> step_scheme(Integrator integrator, double dt_s, bool first) {
  switch (integrator) {
    case Integrator::kBdf2:  // (3 y' − 4 y + y₋₁) / (2 dt) = ẏ', solved for y'
      if (first) break;      // one step of order one costs no order
      return {2 * dt_s / 3, {4.0 / 3, -1.0 / 3}, {4.0 / 3, -1.0 / 3}};
    case Integrator::kQuasiStatic:  // "velocity" is the change of the displacement in a step
      return {1, {1, 0}, {0, 0}};
    case Integrator::kImplicitEuler:
      break;
  }
  return {dt_s, {1, 0}, {1, 0}};
}

}  // namespace tensormass::model
