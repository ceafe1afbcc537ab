#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__AVX__)
#include <immintrin.h>
#endif

#include "core/scalar.h"

/// A pack of numbers that the compiler keeps in one vector register: the CPU's counterpart of a few GPU threads.
/// Formulas templated on their scalar run on it unchanged. Host only.
/// Loops over lanes in full: a vector that is indexed by a loop's variable lives in memory.
#define TM_UNROLL_LANES _Pragma("GCC unroll 8")

namespace tensormass {

template <class Real, int Width>
struct Pack {
  typedef Real Vector __attribute__((vector_size(Width * sizeof(Real))));

  Vector v;

  Pack() = default;
  /// By the vector: what the compiler would generate copies it in narrow pieces, and a wide load behind these waits.
  Pack(const Pack& other) : v(other.v) {}
  Pack& operator=(const Pack& other) {
    v = other.v;
    return *this;
  }
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
template <class Real, int Width>
Pack<Real, Width> select_greater(Pack<Real, Width> a, Pack<Real, Width> b, Pack<Real, Width> x, Pack<Real, Width> y) {
  return Pack<Real, Width>::of(a.v > b.v ? x.v : y.v);
}

/// f(lane) in each lane, one after the other.
template <class Real, int Width, class Function>
Pack<Real, Width> in_each_lane(Pack<Real, Width> a, Function f) {
  for (int lane = 0; lane < Width; ++lane) a.v[lane] = f(a.v[lane]);
  return a;
}
template <class Real, int Width>
Pack<Real, Width> square_root(Pack<Real, Width> a) {
  return in_each_lane(a, [](Real x) { return std::sqrt(x); });
}
#if defined(__AVX__)
// One instruction, which the compiler does not always find.
inline Pack<float, 8> square_root(Pack<float, 8> a) { return Pack<float, 8>::of(_mm256_sqrt_ps(a.v)); }
inline Pack<double, 4> square_root(Pack<double, 4> a) { return Pack<double, 4>::of(_mm256_sqrt_pd(a.v)); }
#endif
template <class Real, int Width>
Pack<Real, Width> exponential(Pack<Real, Width> a) {
  return in_each_lane(a, [](Real x) { return std::exp(x); });
}
template <class Real, int Width>
Pack<Real, Width> logarithm(Pack<Real, Width> a) {
  return in_each_lane(a, [](Real x) { return std::log(x); });
}
template <class Real, int Width>
Pack<Real, Width> hyperbolic_sine(Pack<Real, Width> a) {
  return in_each_lane(a, [](Real x) { return std::sinh(x); });
}

/// The interface of SingleLane for `Width` items at once.
template <class Real_, std::uint32_t Width>
struct PackLanes {
  using Real = Real_;
  using Scalar = Pack<Real, static_cast<int>(Width)>;
  static constexpr std::uint32_t kWidth = Width;

  static Scalar load(const Real* p) {
    Scalar result;
    std::memcpy(&result.v, p, sizeof result.v);
    return result;
  }
  static void store(Real* p, Scalar value) { std::memcpy(p, &value.v, sizeof value.v); }

  static Vec3<Scalar> load3(const Real* vectors, std::uint32_t first) {
    return to_lanes([&](std::uint32_t lane) { return vectors + std::size_t{4} * (first + lane); });
  }
  static Vec3<Scalar> gather3(const Real* vectors, const std::uint32_t* index) {
    return to_lanes([&](std::uint32_t lane) { return vectors + std::size_t{4} * index[lane]; });
  }
  static void store3(Real* vectors, std::uint32_t first, const Vec3<Scalar>& value) {
    Vector rows[4] = {value[0].v, value[1].v, value[2].v, Vector{}};
    transpose<4>(rows);
    TM_UNROLL_LANES
    for (std::uint32_t row = 0; row < 4; ++row) {
      Quad quads[kQuads];
      split(rows[row], quads);
      TM_UNROLL_LANES
      for (std::uint32_t i = 0; i < kQuads; ++i) {
        std::memcpy(vectors + std::size_t{4} * (first + row + 4 * i), &quads[i], sizeof(Quad));
      }
    }
  }
  template <std::uint32_t Count>
  static void scatter(Real* records, std::size_t stride, const Scalar (&values)[Count]) {
    static_assert(Count % Width == 0);
    for (std::uint32_t c = 0; c < Count; c += Width) {
      Vector rows[Width];
      TM_UNROLL_LANES
      for (std::uint32_t i = 0; i < Width; ++i) rows[i] = values[c + i].v;
      transpose<Width>(rows);
      TM_UNROLL_LANES
      for (std::uint32_t lane = 0; lane < Width; ++lane) {
        std::memcpy(records + lane * stride + c, &rows[lane], sizeof(Vector));
      }
    }
  }
  /// The other way round: the first `Count` values of each lane's own record.
  template <std::size_t Count, class Address>
  static void gather_records(Scalar (&values)[Count], const Address& address) {
    static_assert(Count >= Width);
    for (std::uint32_t c = 0; c < Count; c += Width) {
      const std::uint32_t first = std::min<std::uint32_t>(c, Count - Width);  // the last ones overlap
      Vector rows[Width];
      TM_UNROLL_LANES
      for (std::uint32_t lane = 0; lane < Width; ++lane) {
        std::memcpy(&rows[lane], address(lane) + first, sizeof(Vector));
      }
      transpose<Width>(rows);
      TM_UNROLL_LANES
      for (std::uint32_t i = 0; i < Width; ++i) values[first + i] = Scalar::of(rows[i]);
    }
  }
  /// Adds to the vectors that the lanes name, one lane after the other: several may name the same.
  static void scatter_add3(Real* vectors, const std::uint32_t* index, const Vec3<Scalar>& value) {
    Vector rows[4] = {value[0].v, value[1].v, value[2].v, Vector{}};
    transpose<4>(rows);
    TM_UNROLL_LANES
    for (std::uint32_t i = 0; i < kQuads; ++i) {
      TM_UNROLL_LANES
      for (std::uint32_t row = 0; row < 4; ++row) {
        Quad quads[kQuads], sum;
        split(rows[row], quads);
        Real* to = vectors + std::size_t{4} * index[row + 4 * i];
        std::memcpy(&sum, to, sizeof sum);
        sum += quads[i];
        std::memcpy(to, &sum, sizeof sum);
      }
    }
  }
  /// In a fixed order, so that runs repeat bitwise.
  static Real sum(Scalar value) {
    Real total = 0;
    TM_UNROLL_LANES
    for (std::uint32_t lane = 0; lane < Width; ++lane) total += value.v[lane];
    return total;
  }
  static Real largest(Scalar value) {
    Real most = value.v[0];
    for (std::uint32_t lane = 1; lane < Width; ++lane)
      most = tensormass::maximum(most, static_cast<Real>(value.v[lane]));
    return most;
  }

 private:
  using Vector = typename Scalar::Vector;
  using Index = std::conditional_t<sizeof(Real) == 4, std::int32_t, std::int64_t>;
  typedef Index Mask __attribute__((vector_size(sizeof(Vector))));
  /// The four reals of one lane while they are not transposed: row lane % 4 holds lanes lane % 4 and, in registers of
  /// eight, lane % 4 + 4. Joined in registers: a wide load behind two narrow stores would wait for both to reach the
  /// cache.
  typedef Real Quad __attribute__((vector_size(4 * sizeof(Real))));
  static constexpr std::uint32_t kQuads = Width / 4;
  static_assert(kQuads == 1 || kQuads == 2);

  static Vector join(const Quad (&quads)[kQuads]) {
    if constexpr (kQuads == 1) {
      return quads[0];
    } else {
      return __builtin_shufflevector(quads[0], quads[1], 0, 1, 2, 3, 4, 5, 6, 7);
    }
  }
  static void split(Vector row, Quad (&quads)[kQuads]) {
    if constexpr (kQuads == 1) {
      quads[0] = row;
    } else {
      quads[0] = __builtin_shufflevector(row, row, 0, 1, 2, 3);
      quads[1] = __builtin_shufflevector(row, row, 4, 5, 6, 7);
    }
  }

  template <class Address>
  static Vec3<Scalar> to_lanes(Address address) {
    Vector rows[4];
    TM_UNROLL_LANES
    for (std::uint32_t row = 0; row < 4; ++row) {
      Quad quads[kQuads];
      TM_UNROLL_LANES
      for (std::uint32_t i = 0; i < kQuads; ++i) std::memcpy(&quads[i], address(row + 4 * i), sizeof(Quad));
      rows[row] = join(quads);
    }
    transpose<4>(rows);
    return {Scalar::of(rows[0]), Scalar::of(rows[1]), Scalar::of(rows[2])};
  }

  /// Transposes the Size × Size blocks that lie side by side in Size registers, by log2(Size) rounds of exchanges.
  template <std::uint32_t Size>
  static void transpose(Vector (&rows)[Size]) {
    exchange<Size, 1>(rows);
    if constexpr (Size > 2) exchange<Size, 2>(rows);
    if constexpr (Size > 4) exchange<Size, 4>(rows);
    static_assert(Size <= 8);
  }
  template <std::uint32_t Size, std::uint32_t Step>
  static void exchange(Vector (&rows)[Size]) {
    Mask low, high;
    TM_UNROLL_LANES
    for (std::uint32_t lane = 0; lane < Width; ++lane) {
      const bool second = (lane & Step) != 0;
      low[lane] = static_cast<Index>(second ? Width + lane - Step : lane);
      high[lane] = static_cast<Index>(second ? Width + lane : lane + Step);
    }
    TM_UNROLL_LANES
    for (std::uint32_t i = 0; i < Size; ++i) {
      if ((i & Step) != 0) continue;
      const Vector a = rows[i], b = rows[i + Step];
      rows[i] = __builtin_shuffle(a, b, low);
      rows[i + Step] = __builtin_shuffle(a, b, high);
    }
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
