#include "model/model.hpp"

namespace diffsim {

const std::string& Model::name(int object) const {
    static const std::string kGroundName = "ground";
    if (object == kGround) return kGroundName;
    return is_cloth(object) ? cloth_of(object).name : bodies[static_cast<std::size_t>(object)].name;
}

}  // namespace diffsim
