#include "zone/side_matrices.hpp"

namespace diffsim {
namespace {

/// matrix * x, by products of a size the compiler knows where bodies alone take part.
template <class Matrix>
SmallVector product(const Matrix& matrix, const SmallVector& x) {
    if (x.size() == 6) return matrix.template topLeftCorner<6, 6>().lazyProduct(x.head<6>());
    if (x.size() == 12) return matrix.template topLeftCorner<12, 12>().lazyProduct(x.head<12>());
    return matrix.lazyProduct(x);
}

}  // namespace

void SideMatrices::add_product(const Zone& zone, double factor, const Coordinates& in, Coordinates& sum) const {
    for (const Part& part : m_parts) scatter(zone, part, factor, product(part.matrix, gather(zone, part, in)), sum);
}

void SideMatrices::add_transposed_product(
    const Zone& zone, double factor, const Coordinates& in, Coordinates& sum) const {
    for (const Part& part : m_parts)
        scatter(zone, part, factor, product(part.matrix.transpose(), gather(zone, part, in)), sum);
}

}  // namespace diffsim
