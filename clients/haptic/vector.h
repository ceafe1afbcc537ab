#pragma once

#include <Eigen/Core>

#include "tensormass/v1/scene.pb.h"

namespace tensormass::haptic {

inline Eigen::Vector3d to_eigen(const v1::Vector3& v) { return {v.x(), v.y(), v.z()}; }

}  // namespace tensormass::haptic
