// The sweep of faintspot.kernels.total_variation.sweep_fgp in C++: same layout, same arithmetic, GCC's vector
// extensions. `state` holds five vectors a pixel (px, py of both versions, g), `rows` three rolling rows.

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

// The hardware's estimate and one Newton step.
template <int W> static inline Vector<W> reciprocal_square_root(Vector<W> a) {
  Vector<W> e;
#if defined(__AVX512F__) && defined(__AVX512VL__)
  if constexpr (W == 16) e = (Vector<W>)_mm512_rsqrt14_ps((__m512)a);
  if constexpr (W == 8) e = (Vector<W>)_mm256_rsqrt14_ps((__m256)a);
  if constexpr (W == 4) e = (Vector<W>)_mm_rsqrt14_ps((__m128)a);
#else
  for (int i = 0; i < W; i++) e[i] = 1.0f / __builtin_sqrtf(a[i]);
  return e;
#endif
  return (-0.5f * e) * (a * e * e - 3.0f);
}

template <int W>
static Vector<W> sweep(float *state, float *rows, long ny, long nx, long current, Vector<W> momentum,
                       Vector<W> inverse) {
  typedef Vector<W> V;
  const long pixel = 5 * W, line = nx * pixel, previous = 2 - current;
  const V one = V{} + 1.0f;
  float *row_qx = rows, *row_qy = rows + nx * W, *row_v = rows + 2 * nx * W;
  V norm{}, v{}, left{};
  auto extrapolate = [&](const float *p, V &qx, V &qy) {
    V px = load<W>(p + current * W), py = load<W>(p + (current + 1) * W);
    qx = momentum * (px - load<W>(p + previous * W)) + px;
    qy = momentum * (py - load<W>(p + (previous + 1) * W)) + py;
  };
  auto project = [&](float *p, V px, V py) {
    V square = px * px + py * py;
    V shrink = reciprocal_square_root<W>(square > one ? square : one);
    store<W>(p + previous * W, px * shrink);
    store<W>(p + (previous + 1) * W, py * shrink);
  };
  for (long x = 0; x < nx; x++) {
    const float *p = state + x * pixel;
    V qx, qy;
    extrapolate(p, qx, qy);
    V d = qx - left + qy;
    norm = d * d + norm;
    v = d - load<W>(p + 4 * W) * inverse;
    store<W>(row_qx + x * W, qx);
    store<W>(row_qy + x * W, qy);
    store<W>(row_v + x * W, v);
    left = qx;
  }
  store<W>(row_v + nx * W, v);
  for (long y = 1; y < ny; y++) {
    V above = load<W>(row_v);
    left = V{};
    for (long x = 0; x < nx; x++) {
      float *p = state + y * line + x * pixel;
      V qx, qy;
      extrapolate(p, qx, qy);
      V qy_above = load<W>(row_qy + x * W);
      V d = (qx - left) + (qy - qy_above);
      norm = d * d + norm;
      v = d - load<W>(p + 4 * W) * inverse;
      V right = load<W>(row_v + (x + 1) * W);
      V px = 0.125f * (right - above) + load<W>(row_qx + x * W);
      V py = 0.125f * (v - above) + qy_above;
      project(p - line, px, py);
      store<W>(row_qx + x * W, qx);
      store<W>(row_qy + x * W, qy);
      store<W>(row_v + x * W, v);
      left = qx;
      above = right;
    }
    store<W>(row_v + nx * W, v);
  }
  V above = load<W>(row_v);
  for (long x = 0; x < nx; x++) {
    V right = load<W>(row_v + (x + 1) * W);
    V px = 0.125f * (right - above) + load<W>(row_qx + x * W);
    project(state + (ny - 1) * line + x * pixel, px, V{});
    above = right;
  }
  return norm;
}

template <int W>
static void sweeps(float *state, float *rows, long ny, long nx, long count, float momentum, float inverse,
                   float *norm) {
  typedef Vector<W> V;
  V last{};
  for (long i = 0; i < count; i++)
    last = sweep<W>(state, rows, ny, nx, i % 2 ? 2 : 0, V{} + momentum, V{} + inverse);
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
