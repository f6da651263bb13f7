#include "math/cholesky_front.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

namespace diffsim {
namespace {

constexpr int kTile = kCholeskyTile;
// Blocks for the caches: a tile of one side is read once for the eight of the other that stay at hand.
constexpr int kGroup = 8 * kTile;     // columns of a panel eliminated together
constexpr int kRowBlock = 8 * kTile;  // rows of the update computed together

// Vectors of the compiler, and not of Eigen, whose vectorization EIGEN_MAX_ALIGN_BYTES=0 turns off.
#if defined(__GNUC__)
#define DIFFSIM_INLINE inline __attribute__((always_inline))
typedef double Two __attribute__((vector_size(2 * sizeof(double)), aligned(sizeof(double)), may_alias));
#else
#define DIFFSIM_INLINE inline
struct Two {
    double a, b;
};
inline Two operator*(const Two& x, const Two& y) { return {x.a * y.a, x.b * y.b}; }
inline Two operator*(const Two& x, double y) { return {x.a * y, x.b * y}; }
inline Two operator-(const Two& x, const Two& y) { return {x.a - y.a, x.b - y.b}; }
inline Two operator+(const Two& x, const Two& y) { return {x.a + y.a, x.b + y.b}; }
#endif

/// One column of a tile, in registers of two numbers.
struct FourInTwos {
    Two low, high;

    DIFFSIM_INLINE void set_zero() { low = high = Two{0.0, 0.0}; }
    DIFFSIM_INLINE void load(const double* p) {
        low = *reinterpret_cast<const Two*>(p);
        high = *reinterpret_cast<const Two*>(p + 2);
    }
    DIFFSIM_INLINE void store(double* p) const {
        *reinterpret_cast<Two*>(p) = low;
        *reinterpret_cast<Two*>(p + 2) = high;
    }
    DIFFSIM_INLINE void add(const FourInTwos& x) {
        low = low + x.low;
        high = high + x.high;
    }
    DIFFSIM_INLINE void scale(double factor) {
        low = low * factor;
        high = high * factor;
    }
    DIFFSIM_INLINE void subtract_product(const FourInTwos& x, double factor) {
        low = low - x.low * factor;
        high = high - x.high * factor;
    }
    DIFFSIM_INLINE void subtract_product(const FourInTwos& x, const FourInTwos& y) {
        low = low - x.low * y.low;
        high = high - x.high * y.high;
    }
};

#if defined(__GNUC__) && defined(__x86_64__)
#define DIFFSIM_WIDE 1
/// The same in one register.
struct FourAtOnce {
    typedef double Four __attribute__((vector_size(4 * sizeof(double)), aligned(sizeof(double)), may_alias));
    Four all;

    DIFFSIM_INLINE void set_zero() { all = Four{0.0, 0.0, 0.0, 0.0}; }
    DIFFSIM_INLINE void load(const double* p) { all = *reinterpret_cast<const Four*>(p); }
    DIFFSIM_INLINE void store(double* p) const { *reinterpret_cast<Four*>(p) = all; }
    DIFFSIM_INLINE void add(const FourAtOnce& x) { all = all + x.all; }
    DIFFSIM_INLINE void scale(double factor) { all = all * factor; }
    DIFFSIM_INLINE void subtract_product(const FourAtOnce& x, double factor) { all = all - x.all * factor; }
    DIFFSIM_INLINE void subtract_product(const FourAtOnce& x, const FourAtOnce& y) { all = all - x.all * y.all; }
};
#endif

/// Four columns of four rows.
template <class Four>
struct Tile {
    Four c0, c1, c2, c3;

    DIFFSIM_INLINE void set_zero() {
        c0.set_zero();
        c1.set_zero();
        c2.set_zero();
        c3.set_zero();
    }
    DIFFSIM_INLINE void load(const double* p, std::ptrdiff_t stride) {
        c0.load(p);
        c1.load(p + stride);
        c2.load(p + 2 * stride);
        c3.load(p + 3 * stride);
    }
    DIFFSIM_INLINE void store(double* p, std::ptrdiff_t stride) const {
        c0.store(p);
        c1.store(p + stride);
        c2.store(p + 2 * stride);
        c3.store(p + 3 * stride);
    }
    /// tile -= A Bᵀ  with `count` columns of A and B.
    DIFFSIM_INLINE void subtract_product(const double* a, const double* b, int count) {
        for (const double* const end = a + kTile * count; a != end; a += kTile, b += kTile) {
            Four column;
            column.load(a);
            c0.subtract_product(column, b[0]);
            c1.subtract_product(column, b[1]);
            c2.subtract_product(column, b[2]);
            c3.subtract_product(column, b[3]);
        }
    }
    /// tile = tile L⁻ᵀ,  with L the tile at `l` and the inverse of its diagonal.
    DIFFSIM_INLINE void solve(const double* l, const double* inverse) {
        c0.scale(inverse[0]);
        c1.subtract_product(c0, l[1]);
        c1.scale(inverse[1]);
        c2.subtract_product(c0, l[2]);
        c2.subtract_product(c1, l[kTile + 2]);
        c2.scale(inverse[2]);
        c3.subtract_product(c0, l[3]);
        c3.subtract_product(c1, l[kTile + 3]);
        c3.subtract_product(c2, l[2 * kTile + 3]);
        c3.scale(inverse[3]);
    }
};

/// Cholesky factor of a tile in place; what stands above the diagonal becomes zero.
DIFFSIM_INLINE bool factorize_tile(double* a, double* inverse) {
    for (int c = 0; c < kTile; ++c) {
        double* const column = a + kTile * c;
        for (int k = 0; k < c; ++k)
            for (int r = c; r < kTile; ++r) column[r] -= a[kTile * k + r] * a[kTile * k + c];
        const double pivot = column[c];
        if (!(pivot > 0.0 && pivot <= std::numeric_limits<double>::max())) return false;
        const double root = std::sqrt(pivot);
        inverse[c] = 1.0 / root;
        for (int r = 0; r < c; ++r) column[r] = 0.0;
        column[c] = root;
        for (int r = c + 1; r < kTile; ++r) column[r] *= inverse[c];
    }
    return true;
}

template <class Four>
DIFFSIM_INLINE bool factorize_front(const CholeskyFront& front) {
    const int width = front.width, rows = front.width + front.below;
    const std::ptrdiff_t row_stride = width;  // from a row to the next in the factor, on average
    Tile<Four> tile;
    for (int group = 0; group < width; group += kGroup) {
        const int group_end = std::min(group + kGroup, width);
        if (group > 0) {
            for (int r = group; r < rows; r += kTile) {
                for (int c = group; c < group_end && c <= r; c += kTile) {
                    double* const place = front.panel + static_cast<std::ptrdiff_t>(c) * rows + r;
                    tile.load(place, rows);
                    tile.subtract_product(front.factor + r * row_stride, front.factor + c * row_stride, group);
                    tile.store(place, rows);
                }
            }
        }
        for (int c = group; c < group_end; c += kTile) {
            const double* const b = front.factor + c * row_stride + kTile * group;
            double* const diagonal = front.factor + c * row_stride + kTile * c;
            for (int r = c; r < rows; r += kTile) {
                tile.load(front.panel + static_cast<std::ptrdiff_t>(c) * rows + r, rows);
                tile.subtract_product(front.factor + r * row_stride + kTile * group, b, c - group);
                if (r == c) {
                    tile.store(diagonal, kTile);
                    if (!factorize_tile(diagonal, front.inverse + c)) return false;
                } else {
                    tile.solve(diagonal, front.inverse + c);
                    tile.store(front.factor + r * row_stride + kTile * c, kTile);
                }
            }
        }
    }
    const double* const factor = front.factor + width * row_stride;
    for (int block = 0; block < front.below; block += kRowBlock) {
        const int block_end = std::min(block + kRowBlock, front.below);
        for (int c = 0; c < block_end; c += kTile) {
            for (int r = std::max(c, block); r < block_end; r += kTile) {
                tile.set_zero();
                tile.subtract_product(factor + r * row_stride, factor + c * row_stride, width);
                tile.store(front.update + static_cast<std::ptrdiff_t>(c) * front.below + r, front.below);
            }
        }
    }
    return true;
}

/// x = L⁻¹ x of a front: first its own columns, then what they take from the rows below.
template <class Four>
DIFFSIM_INLINE void solve_front(const double* factor, const double* inverse, int width, int rows, double* x) {
    for (int r = 0; r < rows; r += kTile, factor += kTile * width) {
        const int count = std::min(r, width);
        Four even, odd, column;  // two sums, so that one addition need not wait for the other
        even.load(x + r);
        odd.set_zero();
        for (int k = 0; k < count; k += 2) {
            column.load(factor + kTile * k);
            even.subtract_product(column, x[k]);
            column.load(factor + kTile * (k + 1));
            odd.subtract_product(column, x[k + 1]);
        }
        even.add(odd);
        even.store(x + r);
        if (r >= width) continue;
        const double* const l = factor + kTile * r;
        x[r] *= inverse[r];
        x[r + 1] = (x[r + 1] - l[1] * x[r]) * inverse[r + 1];
        x[r + 2] = (x[r + 2] - l[2] * x[r] - l[kTile + 2] * x[r + 1]) * inverse[r + 2];
        x[r + 3] = (x[r + 3] - l[3] * x[r] - l[kTile + 3] * x[r + 1] - l[2 * kTile + 3] * x[r + 2]) * inverse[r + 3];
    }
}

/// The transposed system: the own columns of x from the rows below. `partials` has kTile numbers per column.
template <class Four>
DIFFSIM_INLINE void solve_front_transposed(
    const double* factor, const double* inverse, int width, int rows, double* x, double* partials) {
    std::fill(partials, partials + kTile * width, 0.0);
    for (int r = rows - kTile; r >= 0; r -= kTile) {
        const double* const tiles = factor + static_cast<std::ptrdiff_t>(r) * width;
        if (r < width) {
            const double* const p = partials + kTile * r;
            const double* const l = tiles + kTile * r;
            for (int i = 0; i < kTile; ++i)
                x[r + i] += (p[kTile * i] + p[kTile * i + 1]) + (p[kTile * i + 2] + p[kTile * i + 3]);
            x[r + 3] *= inverse[r + 3];
            x[r + 2] = (x[r + 2] - l[2 * kTile + 3] * x[r + 3]) * inverse[r + 2];
            x[r + 1] = (x[r + 1] - l[kTile + 3] * x[r + 3] - l[kTile + 2] * x[r + 2]) * inverse[r + 1];
            x[r] = (x[r] - l[3] * x[r + 3] - l[2] * x[r + 2] - l[1] * x[r + 1]) * inverse[r];
        }
        Four four, column, partial;
        four.load(x + r);
        const int count = std::min(r, width);
        for (int k = 0; k < count; ++k) {
            column.load(tiles + kTile * k);
            partial.load(partials + kTile * k);
            partial.subtract_product(column, four);
            partial.store(partials + kTile * k);
        }
    }
}

// One set of kernels per kind of processor, chosen when the program runs.
#define DIFFSIM_CHOLESKY_KERNELS(name, attribute, Four)                                                        \
    attribute bool factorize_##name(const CholeskyFront& front) { return factorize_front<Four>(front); }       \
    attribute void solve_##name(const double* factor, const double* inverse, int width, int rows, double* x) { \
        solve_front<Four>(factor, inverse, width, rows, x);                                                    \
    }                                                                                                          \
    attribute void solve_transposed_##name(                                                                    \
        const double* factor, const double* inverse, int width, int rows, double* x, double* partials) {       \
        solve_front_transposed<Four>(factor, inverse, width, rows, x, partials);                               \
    }                                                                                                          \
    constexpr CholeskyKernels name{factorize_##name, solve_##name, solve_transposed_##name};

DIFFSIM_CHOLESKY_KERNELS(kPortable, , FourInTwos)
#if defined(DIFFSIM_WIDE)
DIFFSIM_CHOLESKY_KERNELS(kWide, __attribute__((target("avx2"))), FourAtOnce)
#endif

}  // namespace

const CholeskyKernels& portable_cholesky_kernels() { return kPortable; }

const CholeskyKernels& cholesky_kernels() {
#if defined(DIFFSIM_WIDE)
    if (__builtin_cpu_supports("avx2")) return kWide;
#endif
    return kPortable;
}

}  // namespace diffsim
