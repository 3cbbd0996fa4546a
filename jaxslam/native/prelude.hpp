// Numbers of W runs at a time: vectors, and functions of them.
#include <cmath>
#include <cstdint>
#include <cstring>

typedef SCALAR V __attribute__((vector_size(WIDTH * sizeof(SCALAR)), may_alias, aligned(sizeof(SCALAR) * WIDTH)));
constexpr int W = WIDTH;

#define HIDDEN __attribute__((noinline, visibility("hidden")))

// Constant arrays, from a file, in the first part.
#if PART
#elif defined(__APPLE__)
asm(".const_data\n.balign 64\n.globl _jaxslam_tables\n.private_extern _jaxslam_tables\n_jaxslam_tables:\n.incbin \"" TABLES "\"\n.text");
#else
asm(".pushsection .rodata\n.balign 64\n.globl jaxslam_tables\n.hidden jaxslam_tables\njaxslam_tables:\n.incbin \"" TABLES "\"\n.popsection");
#endif
extern "C" const char jaxslam_tables[] __attribute__((visibility("hidden")));

#define AT(offset) (*(V *)(m + (offset)))
#define ZERO (V{})
#define ONE (V{} + (SCALAR)1)
#define C(x) (V{} + (SCALAR)(x))

#define EACH(name, function)                                                                  \
  static inline V l_##name(V x) {                                                             \
    V y;                                                                                      \
    for (int l = 0; l < W; ++l) y[l] = function(x[l]);                                        \
    return y;                                                                                 \
  }
#define EACH_TWO(name, function)                                                              \
  static inline V l_##name(V x, V y) {                                                        \
    V z;                                                                                      \
    for (int l = 0; l < W; ++l) z[l] = function(x[l], y[l]);                                  \
    return z;                                                                                 \
  }
EACH(floor, std::floor)
EACH(ceil, std::ceil)
EACH(rint, std::rint)
EACH(round, std::round)
EACH(trunc, std::trunc)
EACH(sqrt, std::sqrt)
EACH(cbrt, std::cbrt)
EACH(fabs, std::fabs)
EACH(tan, std::tan)
EACH(asin, std::asin)
EACH(acos, std::acos)
EACH(atan, std::atan)
EACH(sinh, std::sinh)
EACH(cosh, std::cosh)
EACH(tanh, std::tanh)
EACH(expm1, std::expm1)
EACH(log1p, std::log1p)
EACH_TWO(atan2, std::atan2)
EACH_TWO(pow, std::pow)
EACH_TWO(fmod, std::fmod)
#ifdef VECTOR_MATH
extern "C" V VECTOR_MATH(sin)(V);
extern "C" V VECTOR_MATH(cos)(V);
extern "C" V VECTOR_MATH(exp)(V);
extern "C" V VECTOR_MATH(log)(V);
static inline V l_sin(V x) { return VECTOR_MATH(sin)(x); }
static inline V l_cos(V x) { return VECTOR_MATH(cos)(x); }
static inline V l_exp(V x) { return VECTOR_MATH(exp)(x); }
static inline V l_log(V x) { return VECTOR_MATH(log)(x); }
#else
EACH(sin, std::sin)
EACH(cos, std::cos)
EACH(exp, std::exp)
EACH(log, std::log)
#endif
static inline V l_max(V x, V y) { return x != x ? x : (x > y ? x : y); }
static inline V l_min(V x, V y) { return x != x ? x : (x < y ? x : y); }
static inline V l_is_finite(V x) { return (x - x) == 0 ? ONE : ZERO; }
static inline V l_within(V x, V low, V high) { return x >= low & x <= high ? ZERO : C(NAN); }
static inline V l_apart_from_zero(V x) { return x > 0 | x < 0 ? ZERO : C(NAN); }
static inline V l_sign(V x) { return x > 0 ? ONE : (x < 0 ? -ONE : x); }
static inline bool l_any(V x) {
  for (int l = 0; l < W; ++l)
    if (x[l] != 0) return true;
  return false;
}

// A Bᵀ, or C + SIGN A Bᵀ, by tiles of M × N sums. A tile is its rows' and its columns' places for every k, of which
// those count that are in a list: first row, first column, begin of the list, and its length.
template <int M, int N, int SIGN>
__attribute__((noinline)) static void product(char *m, const int *A, const int *B, const int *places, const int16_t *list,
                    const int *tile, int tiles, const int *addend) {
  for (; tiles; --tiles, tile += 4, places += M * N) {
    V sum[M][N] = {};
    if (SIGN) {
#pragma GCC unroll 16
      for (int i = 0; i < M; ++i)
#pragma GCC unroll 16
        for (int j = 0; j < N; ++j) sum[i][j] = AT(addend[i * N + j]);
      addend += M * N;
    }
    const int *a = A + tile[0], *b = B + tile[1];
    const int16_t *k = list + tile[2];
    asm("" : "+r"(a), "+r"(b));  // two pointers, not one for every row of a known table
    for (const int16_t *end = k + tile[3]; k < end; ++k) {
      const int *row = a + *k * M, *column = b + *k * N;
      V x[M];
#pragma GCC unroll 16
      for (int i = 0; i < M; ++i) x[i] = AT(row[i]);
#pragma GCC unroll 16
      for (int j = 0; j < N; ++j) {
        const V y = AT(column[j]);
#pragma GCC unroll 16
        for (int i = 0; i < M; ++i) sum[i][j] += SIGN < 0 ? -(x[i] * y) : x[i] * y;
      }
    }
#pragma GCC unroll 16
    for (int i = 0; i < M; ++i)
#pragma GCC unroll 16
      for (int j = 0; j < N; ++j) AT(places[i * N + j]) = sum[i][j];
  }
}

// made[e] = table[which[e]], by run.
static void take(char *m, const int *made, const int *table, const int *which, int count) {
  for (int e = 0; e < count; ++e) {
    const V at = AT(which[e]);
    V x;
    for (int l = 0; l < W; ++l) x[l] = ((const SCALAR *)(m + table[(long)at[l]]))[l];
    AT(made[e]) = x;
  }
}

// made[which[e]] =, += or *= values[e], or the less or the greater of both, by run, unless it is negative.
template <char BY>
static void put(char *m, const int *made, const int *which, const int *values, int count) {
  for (int e = 0; e < count; ++e) {
    const V at = AT(which[e]), x = AT(values[e]);
    for (int l = 0; l < W; ++l) {
      if (at[l] < 0) continue;
      SCALAR *place = (SCALAR *)(m + made[(long)at[l]]) + l;
      const SCALAR old = *place;
      if (BY == '=' || BY == '+' || BY == '*')
        *place = BY == '+' ? old + x[l] : BY == '*' ? old * x[l] : x[l];
      else if (old == old && !(BY == '<' ? old < x[l] : old > x[l]))
        *place = x[l];
    }
  }
}

// made[e] = table[which[0]][e], by run.
static void row_take(char *m, const int *made, const int *table, const int *which, int count) {
  const V at = AT(which[0]);
  const int *rows[W];
  for (int l = 0; l < W; ++l) rows[l] = table + (long)at[l] * count;
  for (int e = 0; e < count; ++e) {
    V x;
    for (int l = 0; l < W; ++l) x[l] = ((const SCALAR *)(m + rows[l][e]))[l];
    AT(made[e]) = x;
  }
}

// made[which[0]][e] = values[e], by run, unless it is negative.
static void row_put(char *m, const int *made, const int *which, const int *values, int count) {
  const V at = AT(which[0]);
  const int *rows[W];
  int lanes[W], some = 0;
  for (int l = 0; l < W; ++l) {
    if (at[l] < 0) continue;
    rows[some] = made + (long)at[l] * count;
    lanes[some++] = l;
  }
  for (int e = 0; e < count; ++e)
    for (int k = 0; k < some; ++k)
      ((SCALAR *)(m + rows[k][e]))[lanes[k]] = ((const SCALAR *)(m + values[e]))[lanes[k]];
}

// NaN where one of these is not finite.
static inline V doubts(char *m, const int *which, int count) {
  V sum = ZERO;
  for (int e = 0; e < count; ++e) sum += AT(which[e]) * ZERO;
  return sum;
}

static void copy(char *m, const int *to, const int *from, int count) {
  for (int e = 0; e < count; ++e) AT(to[e]) = AT(from[e]);
}

// Rows of n numbers of several arrays in the order of the first `keys` of them, by insertion.
static void sort(char *m, const int *made, int arrays, int rows, int n, int keys) {
  auto at = [&](int array, int row, int i, int l) -> SCALAR & {
    return ((SCALAR *)(m + made[(array * rows + row) * n + i]))[l];
  };
  for (int row = 0; row < rows; ++row)
    for (int l = 0; l < W; ++l)
      for (int i = 1; i < n; ++i)
        for (int j = i; j > 0; --j) {
          int order = 0;
          for (int key = 0; key < keys && !order; ++key) {
            const SCALAR x = at(key, row, j - 1, l), y = at(key, row, j, l);
            order = (x != x && y == y) || x > y ? 1 : (y != y && x == x) || x < y ? -1 : 0;
          }
          if (order <= 0) break;
          for (int array = 0; array < arrays; ++array) {
            const SCALAR x = at(array, row, j - 1, l);
            at(array, row, j - 1, l) = at(array, row, j, l);
            at(array, row, j, l) = x;
          }
        }
}

template <class T>
static void load(char *m, const void *given, long size, int begin, long first, long count,
                 bool each) {
  const T *x = (const T *)given;
  for (long e = 0; e < size; ++e) {
    V y;
    for (int l = 0; l < W; ++l)
      y[l] = x[(each ? first + (l < count ? l : 0) : 0) * size + e];
    AT(begin + e * (long)sizeof(V)) = y;
  }
}

template <class T>
static void store(char *m, void *given, long size, const int *from, long first, long count) {
  T *x = (T *)given;
  for (long e = 0; e < size; ++e)
    for (long l = 0; l < count; ++l) x[(first + l) * size + e] = (T)AT(from[e])[l];
}
