#pragma once

namespace diffsim {

/// Rows of a tile. A panel of the factor with w columns is stored in tiles: entry (r, c) stands at
/// (r / 4) 4w + 4c + r % 4, so that a product L Lᵀ reads both of its factors from front to back.
inline constexpr int kCholeskyTile = 4;

/// The next number of rows or columns that makes whole tiles.
constexpr int padded_to_tiles(int count) { return (count + kCholeskyTile - 1) / kCholeskyTile * kCholeskyTile; }

/// One step of a multifrontal Cholesky factorization: a dense matrix  [A  Bᵀ; B  C]  of which A is eliminated.
struct CholeskyFront {
    int width, below;  ///< rows of A and of B, multiples of kCholeskyTile
    double* panel;     ///< [A; B], column-major; overwritten. What stands above the diagonal of A is not used
    double* factor;    ///< becomes L = [L_A; L_B] in tiles; those above the diagonal are left alone
    double* inverse;   ///< becomes the inverse of the diagonal of L
    double* update;    ///< becomes −L_B L_Bᵀ, column-major; the same holds
};

/// The dense part of the work, which is most of it.
struct CholeskyKernels {
    /// False if A is not positive definite or not finite.
    bool (*factorize)(const CholeskyFront& front);
    /// x_A becomes  L_A⁻¹ x_A,  then x_B becomes  x_B − L_B x_A. x has `rows` = width + below entries.
    void (*solve)(const double* factor, const double* inverse, int width, int rows, double* x);
    /// x_A becomes  L_A⁻ᵀ (x_A − L_Bᵀ x_B). Work space: kCholeskyTile * width numbers.
    void (*solve_transposed)(
        const double* factor, const double* inverse, int width, int rows, double* x, double* partials);
};

/// The fastest for this processor. All give the same bits: each number sees the same operations in the same order, in
/// registers of any width, and products are never fused with sums.
const CholeskyKernels& cholesky_kernels();
/// Those that run everywhere.
const CholeskyKernels& portable_cholesky_kernels();

}  // namespace diffsim
