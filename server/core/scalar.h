#pragma once

#include <cmath>
#include <cstdint>

#include <Eigen/Core>

/// Marks functions that are compiled for the host and for the device from one source.
#if defined(__CUDACC__)
#define TM_HOST_DEVICE __host__ __device__
#else
#define TM_HOST_DEVICE
#endif

/// Inlines every call that the marked function makes. Without it, GCC leaves Eigen's small products on packs as calls
/// that pass vectors through memory. Disabled under sanitizers: with instrumented accesses, compiling one file takes
/// minutes.
#if defined(__CUDACC__) || defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define TM_FLATTEN
#else
#define TM_FLATTEN [[gnu::flatten]]
#endif

/// Unrolls the following loop `count` times on a device. A GPU thread that walks a matrix row then has several loads in
/// flight, which hides memory latency.
#if defined(__CUDA_ARCH__)
#define TM_UNROLL(count) _Pragma(TM_STRING(unroll count))
#define TM_STRING(text) #text
/// Unrolls the following loop completely on a device, so that a small array indexed by it stays in registers.
#define TM_UNROLL_ALL _Pragma("unroll")
#else
#define TM_UNROLL(count)
#define TM_UNROLL_ALL
#endif

namespace tensormass {

template <class T>
using Vec3 = Eigen::Matrix<T, 3, 1>;
template <class T>
using Mat3 = Eigen::Matrix<T, 3, 3>;

/// Reads the first three of four adjacent reals. On a device, p must be aligned to four reals, because a float4 is
/// loaded at once.
template <class Real>
TM_HOST_DEVICE Vec3<Real> read3(const Real* p) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    const float4 v = *reinterpret_cast<const float4*>(p);
    return {v.x, v.y, v.z};
  }
#endif
  return {p[0], p[1], p[2]};
}

/// Writes the first three of four adjacent reals, aligned as for read3. May overwrite the fourth.
template <class Real>
TM_HOST_DEVICE void write3(Real* p, const Vec3<Real>& v) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    *reinterpret_cast<float4*>(p) = {v[0], v[1], v[2], 0};
    return;
  }
#endif
  p[0] = v[0];
  p[1] = v[1];
  p[2] = v[2];
}

/// Loads a value that a step reads only once. On a device it is marked as the first to evict from L2, which is smaller
/// than large scenes: data that the step reads again stays cached. T has 4, 8 or 16 bytes.
template <class T>
TM_HOST_DEVICE T read_once(const T* p) {
#if defined(__CUDA_ARCH__)
  std::uint64_t first_to_go;
  asm("createpolicy.fractional.L2::evict_first.b64 %0, 1.0;" : "=l"(first_to_go));
  static_assert(sizeof(T) == 4 || sizeof(T) == 8 || sizeof(T) == 16);
  union {
    std::uint32_t words[sizeof(T) / 4];
    T value;
  } read;
  if constexpr (sizeof(T) == 4) {
    asm("ld.global.L2::cache_hint.b32 %0, [%1], %2;" : "=r"(read.words[0]) : "l"(p), "l"(first_to_go));
  } else if constexpr (sizeof(T) == 8) {
    asm("ld.global.L2::cache_hint.v2.b32 {%0, %1}, [%2], %3;"
        : "=r"(read.words[0]), "=r"(read.words[1])
        : "l"(p), "l"(first_to_go));
  } else {
    asm("ld.global.L2::cache_hint.v4.b32 {%0, %1, %2, %3}, [%4], %5;"
        : "=r"(read.words[0]), "=r"(read.words[1]), "=r"(read.words[2]), "=r"(read.words[3])
        : "l"(p), "l"(first_to_go));
  }
  return read.value;
#else
  return *p;
#endif
}

/// Prefetches *p into a device's L2 cache. Does nothing on the host.
template <class T>
TM_HOST_DEVICE void expect([[maybe_unused]] const T* p) {
#if defined(__CUDA_ARCH__)
  asm volatile("prefetch.global.L2 [%0];" ::"l"(p));
#endif
}

/// Elementary functions as overloads, so that one formula serves numbers and packs of numbers (core/pack.h adds the
/// overloads for packs).
///
/// If an argument is NaN, minimum and maximum return `a`, and select_greater returns y.
template <class Real>
TM_HOST_DEVICE constexpr Real minimum(Real a, Real b) {
  return b < a ? b : a;
}
template <class Real>
TM_HOST_DEVICE constexpr Real maximum(Real a, Real b) {
  return a < b ? b : a;
}
template <class Real>
TM_HOST_DEVICE constexpr Real absolute(Real a) {
  return a < Real(0) ? -a : a;
}
/// Returns a > b ? x : y.
template <class Real>
TM_HOST_DEVICE constexpr Real select_greater(Real a, Real b, Real x, Real y) {
  return a > b ? x : y;
}
/// Returns whether a > b, in every lane of a pack. Only for work that may be left out where it changes nothing: results
/// must not depend on the neighbours in a pack.
template <class Real>
TM_HOST_DEVICE constexpr bool all_greater(Real a, Real b) {
  return a > b;
}
template <class Real>
TM_HOST_DEVICE Real square_root(Real a) {
  return std::sqrt(a);
}
/// Returns a / b. On a device in single precision the error is up to two units in the last place: the exact division is
/// a function call, and two of them lie on the critical path of every CG iteration.
template <class Real>
TM_HOST_DEVICE Real quotient(Real a, Real b) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) return __fdividef(a, b);
#endif
  return a / b;
}
/// Returns 1 / √a. On a device the error is up to two units in the last place, for the same reason as in quotient.
template <class Real>
TM_HOST_DEVICE Real inverse_square_root(Real a) {
#if defined(__CUDA_ARCH__)
  return rsqrt(a);
#else
  return 1 / std::sqrt(a);
#endif
}
template <class Real>
TM_HOST_DEVICE Real exponential(Real a) {
  return std::exp(a);
}
template <class Real>
TM_HOST_DEVICE Real logarithm(Real a) {
  return std::log(a);
}
template <class Real>
TM_HOST_DEVICE Real hyperbolic_sine(Real a) {
  return std::sinh(a);
}

/// Returns [a]×, for which [a]× b = a × b.
template <class Real>
TM_HOST_DEVICE Mat3<Real> cross_matrix(const Vec3<Real>& a) {
  Mat3<Real> m;
  m << 0, -a[2], a[1], a[2], 0, -a[0], -a[1], a[0], 0;
  return m;
}

/// The Lanes interface: how a loop body reads and writes `kWidth` consecutive items at once. This version has one lane,
/// which is what a GPU thread handles. PackLanes (core/pack.h) has as many as a vector register.
///
/// Vectors are stored as [.., 4] reals. The fourth is padding: load3 may read it and store3 may overwrite it.
template <class Real_>
struct SingleLane {
  using Real = Real_;
  using Scalar = Real_;
  static constexpr std::uint32_t kWidth = 1;

  /// Loads kWidth consecutive reals from p.
  TM_HOST_DEVICE static Scalar load(const Real* p) { return *p; }
  /// Stores kWidth consecutive reals to p.
  TM_HOST_DEVICE static void store(Real* p, Scalar value) { *p = value; }
  /// Loads the vectors first to first + kWidth − 1.
  TM_HOST_DEVICE static Vec3<Scalar> load3(const Real* vectors, std::uint32_t first) {
    return read3(vectors + std::size_t{4} * first);
  }
  /// Stores to the vectors first to first + kWidth − 1.
  TM_HOST_DEVICE static void store3(Real* vectors, std::uint32_t first, const Vec3<Scalar>& value) {
    write3(vectors + std::size_t{4} * first, value);
  }
  /// Loads vector index[lane] into each lane.
  TM_HOST_DEVICE static Vec3<Scalar> gather3(const Real* vectors, const std::uint32_t* index) {
    return load3(vectors, *index);
  }
  /// Writes `Count` values into a record for each lane. Records start `stride` reals apart.
  template <std::uint32_t Count>
  TM_HOST_DEVICE static void scatter(Real* records, std::size_t /*stride*/, const Scalar (&values)[Count]) {
    for (std::uint32_t c = 0; c < Count; ++c) records[c] = values[c];
  }
  /// Returns the sum over the lanes.
  TM_HOST_DEVICE static Real sum(Scalar value) { return value; }
  /// Returns the largest of the lanes.
  TM_HOST_DEVICE static Real largest(Scalar value) { return value; }
};

}  // namespace tensormass
