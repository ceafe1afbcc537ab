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

/// Packs: vectors of numbers that the compiler keeps in one vector register. Host only.
///
/// Why: the CPU evaluates several elements or nodes at once, one in each lane of a register, as a GPU does with
/// threads. Physics is templated on its scalar type T, so the same formula runs on a number and on a pack. A formula
/// therefore has no branch on a value; it uses minimum, maximum and select_greater.
///
/// Memory holds vectors as four adjacent reals (three and one of padding), but formulas want one register for each
/// component. PackLanes converts between the two by transposing 4 × 4 blocks within registers:
///
///   memory                     rows, as loaded        after transpose<4>
///   node 0: x0 y0 z0 _         x0 y0 z0 _             x: x0 x1 x2 x3
///   node 1: x1 y1 z1 _    →    x1 y1 z1 _      →      y: y0 y1 y2 y3
///   node 2: x2 y2 z2 _         x2 y2 z2 _             z: z0 z1 z2 z3
///   node 3: x3 y3 z3 _         x3 y3 z3 _             padding
///
/// A register of eight floats holds two such blocks side by side: lanes 0 to 3 and lanes 4 to 7.

/// Unrolls a loop over lanes completely. GCC otherwise keeps a vector that the loop's variable indexes in memory.
#define TM_UNROLL_LANES _Pragma("GCC unroll 8")

namespace tensormass {

template <class Real, int Width>
struct Pack {
  typedef Real Vector __attribute__((vector_size(Width * sizeof(Real))));

  Vector v;

  Pack() = default;
  /// Copies the register as a whole. GCC's generated copy moves it in narrow pieces, and a wide load after narrow
  /// stores stalls until they reach the cache.
  Pack(const Pack& other) : v(other.v) {}
  Pack& operator=(const Pack& other) {
    v = other.v;
    return *this;
  }
  template <class Number>
  requires std::is_arithmetic_v<Number> Pack(Number value)
      : v(Vector{} + static_cast<Real>(value)) {}  // NOLINT: numbers mix with packs in formulas

  /// Makes a pack from a vector register.
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

template <class Real, int Width>
bool all_greater(Pack<Real, Width> a, Pack<Real, Width> b) {
  const auto greater = a.v > b.v;
  auto all = greater[0];
  for (int lane = 1; lane < Width; ++lane) all &= greater[lane];
  return all != 0;
}

/// Applies a function to each lane, one after the other.
///
///   f(x)   is called with a lane's number; returns the lane's result
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
// GCC does not always find the single instruction for this.
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

/// The Lanes interface (see SingleLane in core/scalar.h) for `Width` items at once; `Width` is 4 or 8.
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
  /// Reads the first `Count` values of a record for each lane; the inverse of scatter, with records at any address.
  /// `Count` ≥ Width. If `Count` is not a multiple of Width, the last two blocks overlap.
  ///
  ///   address(lane)   returns the start of the lane's record
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
  /// Adds each lane's value to vector index[lane]. Lanes are added one after the other, because several may name the
  /// same vector.
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
  /// Returns the sum over the lanes, in a fixed order so that runs repeat bitwise.
  static Real sum(Scalar value) {
    Real total = 0;
    TM_UNROLL_LANES
    for (std::uint32_t lane = 0; lane < Width; ++lane) total += value.v[lane];
    return total;
  }
  /// Returns the largest of the lanes.
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
  /// The four reals of one lane's vector, before they are transposed. Row r of four registers holds lane r and, if
  /// there are eight lanes, lane r + 4. The two halves are joined in registers: a wide load after two narrow stores
  /// would stall until both reach the cache.
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

  /// Loads a vector of four reals for each lane and transposes them to one pack for each of three components.
  ///
  ///   address(lane)   returns the start of the lane's vector
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

  /// Transposes each of the Size × Size blocks that lie side by side in Size registers. Rounds with
  /// Step = 1, 2, 4 < Size exchange the off-diagonal blocks of Step × Step numbers.
  template <std::uint32_t Size>
  static void transpose(Vector (&rows)[Size]) {
    exchange<Size, 1>(rows);
    if constexpr (Size > 2) exchange<Size, 2>(rows);
    if constexpr (Size > 4) exchange<Size, 4>(rows);
    static_assert(Size <= 8);
  }
  /// One round of transpose: swaps the upper lanes of row i with the lower lanes of row i + Step, for each i without
  /// bit Step.
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

/// Lanes of a 256-bit register, which the x86-64-v3 baseline guarantees.
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
