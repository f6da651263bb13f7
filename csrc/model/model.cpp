#include "model/model.hpp"

namespace diffsim {

const std::string& Model::name(int object) const {
    static const std::string kGroundName = "ground";
    return object == kGround ? kGroundName : bodies[static_cast<std::size_t>(object)].name;
}

}  // namespace diffsim
