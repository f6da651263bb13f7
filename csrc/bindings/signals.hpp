#pragma once

#include <pybind11/pybind11.h>

#include <exception>

#include "parallel/interrupt.hpp"

namespace diffsim::bindings {

namespace py = pybind11;

/// Python's signals, looked for by the thread that called, while it holds no lock.
class Signals {
public:
    /// Do work(interrupt) without the lock. What a signal's handler raised, KeyboardInterrupt say, is thrown on.
    template <typename Work>
    void watch(const Work& work) {
        try {
            const py::gil_scoped_release unlocked;
            work(&m_interrupt);
        } catch (...) {
            if (m_raised) std::rethrow_exception(m_raised);
            throw;
        }
        if (m_raised) std::rethrow_exception(m_raised);
    }

private:
    bool raised() {
        if (m_raised) return true;
        const py::gil_scoped_acquire locked;
        if (PyErr_CheckSignals() != 0) m_raised = std::make_exception_ptr(py::error_already_set());
        return m_raised != nullptr;
    }

    std::exception_ptr m_raised;
    Interrupt m_interrupt{[this] { return raised(); }};
};

}  // namespace diffsim::bindings
