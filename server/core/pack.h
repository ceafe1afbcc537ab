#pragma once

#include <cstring>
#include <utility>

#include "core/scalar.h"

/// A pack of numbers that the compiler keeps in one vector register: the CPU's counterpart of a few GPU threads.
/// Formulas templated on their scalar run on it unchanged. Host only.
namespace tensormass {

template <class Real, int Width>
struct Pack {
  typedef Real Vector __attribute__((vector_size(Width * sizeof(Real))));

  Vector v;

  Pack() = default;
  template <class Number>
  requires std::is_arithmetic_v<Number> Pack(Number value)
      : v(Vector{} + static_cast<Real>(value)) {}  // NOLINT: numbers mix with packs in formulas

  static Pack of(Vector vector) {
    Pack result;
    result.v = vector;
    return result;
  }

  friend Pack operator+(Pack a, Pack b) { return of(a.v + b.v); }
  friend Pack operator-(Pack a, Pack b) { return of(a.v - b.v); }
  friend Pack operator*(Pack a, Pack b) { return of(a.v * b.v); }
  friend Pack operator/(Pack a, Pack b) { return of(a.v / b.v); }
  Pack operator-() const { return of(-v); }
  Pack& operator+=(Pack b) { return *this = *this + b; }
  Pack& operator-=(Pack b) { return *this = *this - b; }
  Pack& operator*=(Pack b) { return *this = *this * b; }
};

template <class Real, int Width>
Pack<Real, Width> minimum(Pack<Real, Width> a, Pack<Real, Width> b) {
  return Pack<Real, Width>::of(b.v < a.v ? b.v : a.v);
}
template <class Real, int Width>
Pack<Real, Width> maximum(Pack<Real, Width> a, Pack<Real, Width> b) {
  return Pack<Real, Width>::of(a.v < b.v ? b.v : a.v);
}
template <class Real, int Width>
Pack<Real, Width> absolute(Pack<Real, Width> a) {
  return maximum(a, -a);
}

/// The interface of SingleLane for `Width` items at once.
template <class Real_, int Width>
struct PackLanes {
  using Real = Real_;
  using Scalar = Pack<Real, Width>;
  static constexpr std::uint32_t kWidth = Width;

  static Scalar load(const Real* p) {
    Scalar result;
    std::memcpy(&result.v, p, sizeof result.v);
    return result;
  }
  static void store(Real* p, Scalar value) { std::memcpy(p, &value.v, sizeof value.v); }

  static Vec3<Scalar> load3(const Real* vectors, std::uint32_t first) {
    return transpose([&](int lane) { return vectors + std::size_t{4} * (first + static_cast<std::uint32_t>(lane)); });
  }
  static Vec3<Scalar> gather3(const Real* vectors, const std::uint32_t* index) {
    return transpose([&](int lane) { return vectors + std::size_t{4} * index[lane]; });
  }
  static void store3(Real* vectors, std::uint32_t first, const Vec3<Scalar>& value) {
    Real* p = vectors + std::size_t{4} * first;
    for (int lane = 0; lane < Width; ++lane) {
      p[4 * lane + 0] = value[0].v[lane];
      p[4 * lane + 1] = value[1].v[lane];
      p[4 * lane + 2] = value[2].v[lane];
    }
  }
  static void scatter(Real* p, std::size_t stride, Scalar value) {
    for (int lane = 0; lane < Width; ++lane) p[lane * stride] = value.v[lane];
  }
  /// In a fixed order, so that runs repeat bitwise.
  static Real sum(Scalar value) {
    Real total = 0;
    for (int lane = 0; lane < Width; ++lane) total += value.v[lane];
    return total;
  }

 private:
  template <class Address>
  static Vec3<Scalar> transpose(Address address) {
    Vec3<Scalar> result;
    for (int lane = 0; lane < Width; ++lane) {
      const Real* p = address(lane);
      result[0].v[lane] = p[0];
      result[1].v[lane] = p[1];
      result[2].v[lane] = p[2];
    }
    return result;
  }
};

/// 256-bit registers: the width that the x86-64-v3 baseline guarantees.
template <class Real>
using NativeLanes = PackLanes<Real, 32 / sizeof(Real)>;

}  // namespace tensormass

template <class Real, int Width>
struct Eigen::NumTraits<tensormass::Pack<Real, Width>> : Eigen::GenericNumTraits<tensormass::Pack<Real, Width>> {
  enum {
    IsComplex = 0,
    IsInteger = 0,
    IsSigned = 1,
    RequireInitialization = 0,
    ReadCost = 1,
    AddCost = 1,
    MulCost = 1
  };
};
