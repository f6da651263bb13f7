// What the build promises to all code: results do not depend on where a buffer happens to lie.
#include "check.hpp"

#include <vector>

namespace test_build_flags {

TEST(eigen_sums_have_the_same_bits_at_any_alignment) {
    constexpr int kSize = 37;
    const Eigen::VectorXd values = check::Random(1).vector(kSize);
    std::vector<double> buffer(kSize + 8);
    for (int shift = 0; shift < 8; ++shift) {  // 8 doubles are a cache line, more than any vector register
        NOTE(shift);
        Eigen::Map<Eigen::VectorXd> shifted(buffer.data() + shift, kSize);
        shifted = values;
        const Eigen::Ref<const Eigen::VectorXd> argument = shifted;
        CHECK(argument.sum() == values.sum());
    }
}

}  // namespace test_build_flags
