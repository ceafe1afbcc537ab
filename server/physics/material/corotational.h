#pragma once

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// W = μ |S − I|² + λ/2 (tr S − 3)² with F = R S, R a rotation: Hooke's law of the stretch (Müller, Gross 2004; with
/// the exact stiffness of Chao, Pinkall, Sanan, Schröder 2010).
///
/// Exact under rotation; stress is linear in the stretches, so it is soft in strong compression and stays finite in
/// collapse. Recovers from inversion: S keeps the sign of the smallest stretch. Any ν in (−1, 0.5), though resistance
/// to change of volume is of first order only. Where two stretches add up to nothing R is not unique and the stress
/// jumps; the stiffness against rotation there is bounded.
struct Corotational : StretchLaw<Corotational>, LameParameters {
  static constexpr const char* kName = "corotational";
  static constexpr Inversion kInversion = Inversion::kRecovers;

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T lambda = parameters[0], two_mu = parameters[1] + parameters[1];
    const Vec3<T> strain = sigma - Vec3<T>::Ones();
    const T pressure = lambda * strain.sum();
    StretchEnergy<T> w;
    w.energy = T(0.5) * (two_mu * strain.squaredNorm() + pressure * strain.sum());
    w.gradient = strain * two_mu + Vec3<T>::Constant(pressure);
    w.hessian = Mat3<T>::Identity() * two_mu + Mat3<T>::Constant(lambda);
    for (int i = 0; i < 3; ++i) {
      const T sum = sigma[(i + 1) % 3] + sigma[(i + 2) % 3];
      w.distortion[i] = two_mu;
      w.rotation[i] = two_mu + T(2) * (pressure - two_mu) / maximum(sum, T(kLeastSum));
    }
    return w;
  }

  /// ψ_ij and D are positive for every ν.
  template <class T>
  TM_HOST_DEVICE static void make_positive(Point<T>& p) {
    for (int i = 0; i < 3; ++i) p.w.rotation[i] = maximum(p.w.rotation[i], T(0));
  }

 private:
  static constexpr double kLeastSum = 0.01;
};

}  // namespace tensormass::physics
