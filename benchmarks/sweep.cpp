// The sweep of faintspot.kernels.sweeps.sweep_fgp in C++: same layout and algorithm, a row at a time as one would
// write it, where the Numba kernel takes rows in pairs and in stages; GCC's vector extensions. `state` holds five vectors a pixel (2 px, 2 py of both versions, g), `rows` qx, qy, v of the row above.

#include <cstddef>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

template <int W> struct Simd { typedef float vector __attribute__((vector_size(4 * W), aligned(4))); };

template <int W> using Vector = typename Simd<W>::vector;

template <int W> static inline Vector<W> load(const float *place) {
  Vector<W> v;
  std::memcpy(&v, place, sizeof v);
  return v;
}

template <int W> static inline void store(float *place, Vector<W> v) { std::memcpy(place, &v, sizeof v); }

// 2 / sqrt(a): the hardware's estimate and one Newton step.
template <int W> static inline Vector<W> twice_reciprocal_square_root(Vector<W> a) {
  Vector<W> e;
#if defined(__AVX512F__) && defined(__AVX512VL__)
  if constexpr (W == 16) e = (Vector<W>)_mm512_rsqrt14_ps((__m512)a);
  if constexpr (W == 8) e = (Vector<W>)_mm256_rsqrt14_ps((__m256)a);
  if constexpr (W == 4) e = (Vector<W>)_mm_rsqrt14_ps((__m128)a);
#else
  for (int i = 0; i < W; i++) e[i] = 2.0f / __builtin_sqrtf(a[i]);
  return e;
#endif
  return e * (3.0f - a * e * e);
}

template <int W, long current>
static Vector<W> sweep(float *state, float *rows, long ny, long nx, Vector<W> momentum, Vector<W> inverse) {
  typedef Vector<W> V;
  const long pixel = 5 * W, line = nx * pixel, previous = 2 - current, slot = 3 * W;
  const V four = V{} + 4.0f, twice_inverse = 2.0f * inverse;
  V norm{}, v{}, left{};
  auto extrapolate = [&](const float *p, V &qx, V &qy) {
    V px = load<W>(p + current * W), py = load<W>(p + (current + 1) * W);
    qx = momentum * (px - load<W>(p + previous * W)) + px;
    qy = momentum * (py - load<W>(p + (previous + 1) * W)) + py;
  };
  auto project = [&](float *p, V px, V py) {
    V square = px * px + py * py;
    V shrink = twice_reciprocal_square_root<W>(square > four ? square : four);
    store<W>(p + previous * W, px * shrink);
    store<W>(p + (previous + 1) * W, py * shrink);
  };
  for (long x = 0; x < nx; x++) {
    const float *p = state + x * pixel;
    V qx, qy;
    extrapolate(p, qx, qy);
    V d = qx - left + qy;
    norm = d * d + norm;
    v = d - load<W>(p + 4 * W) * twice_inverse;
    store<W>(rows + x * slot, qx);
    store<W>(rows + x * slot + W, qy);
    store<W>(rows + x * slot + 2 * W, v);
    left = qx;
  }
  store<W>(rows + nx * slot + 2 * W, v);
  for (long y = 1; y < ny; y++) {
    V above = load<W>(rows + 2 * W);
    left = V{};
    for (long x = 0; x < nx; x++) {
      float *p = state + y * line + x * pixel;
      V qx, qy;
      extrapolate(p, qx, qy);
      V qy_above = load<W>(rows + x * slot + W);
      V d = (qx - left) + (qy - qy_above);
      norm = d * d + norm;
      v = d - load<W>(p + 4 * W) * twice_inverse;
      V right = load<W>(rows + (x + 1) * slot + 2 * W);
      V px = 0.125f * (right - above) + load<W>(rows + x * slot);
      V py = 0.125f * (v - above) + qy_above;
      project(p - line, px, py);
      store<W>(rows + x * slot, qx);
      store<W>(rows + x * slot + W, qy);
      store<W>(rows + x * slot + 2 * W, v);
      left = qx;
      above = right;
    }
    store<W>(rows + nx * slot + 2 * W, v);
  }
  V above = load<W>(rows + 2 * W);
  for (long x = 0; x < nx; x++) {
    V right = load<W>(rows + (x + 1) * slot + 2 * W);
    V px = 0.125f * (right - above) + load<W>(rows + x * slot);
    project(state + (ny - 1) * line + x * pixel, px, V{});
    above = right;
  }
  return 0.25f * norm;
}

template <int W>
static void sweeps(float *state, float *rows, long ny, long nx, long count, float momentum, float inverse,
                   float *norm) {
  typedef Vector<W> V;
  V last{};
  for (long i = 0; i < count; i++)
    last = i % 2 ? sweep<W, 2>(state, rows, ny, nx, V{} + momentum, V{} + inverse)
                 : sweep<W, 0>(state, rows, ny, nx, V{} + momentum, V{} + inverse);
  store<W>(norm, last);
}

#define SWEEPS(W)                                                                                              \
  extern "C" void sweeps_##W(float *state, float *rows, long ny, long nx, long count, float momentum,          \
                             float inverse, float *norm) {                                                     \
    sweeps<W>(state, rows, ny, nx, count, momentum, inverse, norm);                                            \
  }

SWEEPS(16)
SWEEPS(8)
SWEEPS(4)
