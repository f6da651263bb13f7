#pragma once

#include <cstdio>
#include <string>

/// Numbers in messages.
namespace diffsim {

inline std::string number_text(double value) {
    char text[32];
    std::snprintf(text, sizeof text, "%g", value);
    return text;
}

}  // namespace diffsim
