// Runs the registered tests. Arguments select those whose file or name contains one of them:
//     diffsim_tests contact/test_zone.cpp resting
// A run that selects no test fails: a renamed file must not turn a suite green.
#include "check.hpp"

#include <cstring>
#include <iostream>

namespace check {

namespace {

std::vector<Test>& tests() {
    static std::vector<Test> registered;
    return registered;
}

bool is_selected(const Test& test, int filter_count, char** filters) {
    for (int i = 0; i < filter_count; ++i) {
        if (std::strstr(test.where.file, filters[i]) || std::strstr(test.name, filters[i])) return true;
    }
    return filter_count == 0;
}

/// Empty when the test passed.
std::string run(const Test& test) {
    try {
        test.run();
    } catch (const Failure& failure) {
        return failure.what();
    } catch (const std::exception& exception) {
        return std::string("uncaught exception: ") + exception.what();
    } catch (...) {
        return "uncaught exception that is no std::exception";
    }
    return "";
}

}  // namespace

bool register_test(const Test& test) {
    tests().push_back(test);
    return true;
}

std::vector<Printer>& notes() {
    thread_local std::vector<Printer> in_force;
    return in_force;
}

void fail(Location where, const std::string& what) {
    std::ostringstream out;
    out << where.file << ":" << where.line << ": " << what;
    for (const Printer& print_note : notes()) {
        out << "\n    where ";
        print_note(out);
    }
    throw Failure(out.str());
}

Eigen::VectorXd Random::vector(Eigen::Index size, double low, double high) { return matrix(size, 1, low, high); }

Eigen::MatrixXd Random::matrix(Eigen::Index rows, Eigen::Index cols, double low, double high) {
    Eigen::MatrixXd result(rows, cols);
    for (double& entry : result.reshaped()) entry = uniform(low, high);
    return result;
}

}  // namespace check

int main(int argument_count, char** arguments) {
    int passed = 0;
    int failed = 0;
    for (const check::Test& test : check::tests()) {
        if (!check::is_selected(test, argument_count - 1, arguments + 1)) continue;
        const std::string failure = check::run(test);
        if (failure.empty()) {
            ++passed;
        } else {
            ++failed;
            std::cout << "FAILED " << test.name << " (" << test.where.file << ":" << test.where.line << ")\n"
                      << failure << "\n\n";
        }
    }
    if (passed + failed == 0) std::cout << "no test was selected\n";
    std::cout << passed << " passed, " << failed << " failed\n";
    return passed > 0 && failed == 0 ? 0 : 1;
}
