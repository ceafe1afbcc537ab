#include "model/model.h"

#include <algorithm>

namespace tensormass::model {

double Schedule::at(double time) const {
  if (empty()) return 1;
  const auto after = std::upper_bound(time_s.begin(), time_s.end(), time);
  if (after == time_s.begin()) return factor.front();
  if (after == time_s.end()) return factor.back();
  const std::size_t i = static_cast<std::size_t>(after - time_s.begin());
  const double share = (time - time_s[i - 1]) / (time_s[i] - time_s[i - 1]);
  return factor[i - 1] + share * (factor[i] - factor[i - 1]);
}

}  // namespace tensormass::model
