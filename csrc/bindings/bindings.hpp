#pragma once

#include <pybind11/pybind11.h>

/// One function per room; each adds the room's types and functions to the module.
namespace diffsim::bindings {

void bind_collision(pybind11::module_& module);
void bind_contacts(pybind11::module_& module);
void bind_model(pybind11::module_& module);
void bind_rollout(pybind11::module_& module);

}  // namespace diffsim::bindings
