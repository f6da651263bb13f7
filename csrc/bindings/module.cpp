#include "bindings/bindings.hpp"

PYBIND11_MODULE(_core, module) {
    module.doc() = "The C++ core of diffsim. Not a public interface: use the diffsim package.";
    diffsim::bindings::bind_model(module);
    diffsim::bindings::bind_collision(module);
    diffsim::bindings::bind_rollout(module);
    diffsim::bindings::bind_contacts(module);
}
