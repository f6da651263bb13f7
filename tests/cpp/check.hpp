// A small test harness: TEST registers a test, the CHECK macros stop it at the first thing that is wrong.
//
//     TEST(free_fall_matches_its_formula) {
//         for (const double dt : {0.1, 0.01}) {
//             NOTE(dt);  // printed with a failure further down
//             CHECK_NEAR(drop_height(dt), 0.5 * 9.81 * dt * dt, kRounding);
//         }
//     }
#pragma once

#include <Eigen/Core>

#include <cmath>
#include <cstdint>
#include <functional>
#include <ostream>
#include <random>
#include <sstream>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

namespace check {

/// What a failed check throws; it carries the place, the expression, the values and the notes in force.
struct Failure : std::runtime_error {
    using std::runtime_error::runtime_error;
};

struct Location {
    const char* file;
    int line;
};

struct Test {
    const char* name;
    Location where;
    void (*run)();
};

using Printer = std::function<void(std::ostream&)>;

// Defined in test_main.cpp.
bool register_test(const Test& test);  ///< always true, so that a static variable can call it
[[noreturn]] void fail(Location where, const std::string& what);
std::vector<Printer>& notes();  ///< of this thread, outermost first

/// Adds one line to every failure in its scope.
class Note {
public:
    explicit Note(Printer print) { notes().push_back(std::move(print)); }
    ~Note() { notes().pop_back(); }
    Note(const Note&) = delete;
    Note& operator=(const Note&) = delete;
};

template <class T, class = void>
struct IsPrintable : std::false_type {};
template <class T>
struct IsPrintable<T, std::void_t<decltype(std::declval<std::ostream&>() << std::declval<const T&>())>>
    : std::true_type {};

template <class T>
std::string print(const T& value) {
    std::ostringstream out;
    out.precision(17);
    if constexpr (std::is_enum_v<T>) {
        out << static_cast<long long>(value);
    } else if constexpr (IsPrintable<T>::value) {
        out << std::boolalpha << value;
    } else {
        out << "(unprintable)";
    }
    return out.str();
}

// CHECK(a < b) becomes (Capture{} << a) < b, which remembers how a and b look in case the comparison is false.
struct Outcome {
    Outcome(bool is_true, std::string seen = "") : passed(is_true), values(std::move(seen)) {}
    bool passed;
    std::string values;
};

// `size() == 3` compares signs safely when written out; behind a template the compiler no longer sees the literal.
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wsign-compare"
#endif
template <class A>
struct Captured {
    const A& a;

    template <class B>
    Outcome operator==(const B& b) const {
        return outcome(a == b, " == ", b);
    }
    template <class B>
    Outcome operator!=(const B& b) const {
        return outcome(a != b, " != ", b);
    }
    template <class B>
    Outcome operator<(const B& b) const {
        return outcome(a < b, " < ", b);
    }
    template <class B>
    Outcome operator<=(const B& b) const {
        return outcome(a <= b, " <= ", b);
    }
    template <class B>
    Outcome operator>(const B& b) const {
        return outcome(a > b, " > ", b);
    }
    template <class B>
    Outcome operator>=(const B& b) const {
        return outcome(a >= b, " >= ", b);
    }

    explicit operator bool() const { return static_cast<bool>(a); }
    operator Outcome() const { return {static_cast<bool>(a)}; }

private:
    template <class B>
    Outcome outcome(bool passed, const char* comparison, const B& b) const {
        return {passed, passed ? std::string() : print(a) + comparison + print(b)};
    }
};
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif

struct Capture {
    template <class A>
    Captured<A> operator<<(const A& a) const {
        return {a};
    }
};

inline void require(Location where, const char* expression, const Outcome& outcome) {
    if (outcome.passed) return;
    const std::string text = std::string("CHECK(") + expression + ")";
    fail(where, outcome.values.empty() ? text : text + "\n    with " + outcome.values);
}

/// Scalars, or Eigen objects of one shape; `tolerance` is absolute and bounds every entry. NaN is never near.
template <class Actual, class Expected>
void require_near(
    Location where, const char* expression, const Actual& actual, const Expected& expected, double tolerance) {
    const auto reject = [&](const std::string& why) {
        fail(where, std::string("CHECK_NEAR(") + expression + ")\n    " + why + ", tolerance " + print(tolerance));
    };
    const auto compare = [&](double a, double b, const std::string& place) {
        const double error = std::abs(a - b);
        if (!(error <= tolerance)) {
            reject(print(a) + " is not near " + print(b) + place + ", difference " + print(error));
        }
    };
    if constexpr (std::is_arithmetic_v<Actual>) {
        compare(static_cast<double>(actual), static_cast<double>(expected), "");
    } else {
        const typename Actual::PlainObject a = actual;
        const typename Expected::PlainObject b = expected;
        if (a.rows() != b.rows() || a.cols() != b.cols()) {
            reject(
                "shape (" + print(a.rows()) + ", " + print(a.cols()) + ") is not (" + print(b.rows()) + ", " +
                print(b.cols()) + ")");
        }
        for (Eigen::Index row = 0; row < a.rows(); ++row) {
            for (Eigen::Index col = 0; col < a.cols(); ++col) {
                compare(a(row, col), b(row, col), " at (" + print(row) + ", " + print(col) + ")");
            }
        }
    }
}

/// `message_part` must occur in what() of the exception, so that a test can hold the message to naming its cause.
template <class Exception, class Call>
void require_throws(Location where, const char* expression, Call&& call, const std::string& message_part) {
    const std::string text = std::string("CHECK_THROWS(") + expression + ")\n    ";
    try {
        call();
    } catch (const std::exception& exception) {
        const std::string message = exception.what();
        if (dynamic_cast<const Exception*>(&exception) == nullptr) fail(where, text + "threw another type: " + message);
        if (message.find(message_part) != std::string::npos) return;
        fail(where, text + "message \"" + message + "\" does not contain \"" + message_part + "\"");
    }
    fail(where, text + "did not throw");
}

/// Seeded numbers that are the same with every standard library; std's distributions are not.
class Random {
public:
    explicit Random(std::uint64_t seed) : m_engine(seed) {}

    double uniform(double low = -1.0, double high = 1.0) {
        constexpr double kUnit = 1.0 / 9007199254740992.0;  // 2⁻⁵³
        return low + (high - low) * static_cast<double>(m_engine() >> 11) * kUnit;
    }
    Eigen::VectorXd vector(Eigen::Index size, double low = -1.0, double high = 1.0);
    Eigen::MatrixXd matrix(Eigen::Index rows, Eigen::Index cols, double low = -1.0, double high = 1.0);

private:
    std::mt19937_64 m_engine;
};

struct GradientOptions {
    double step = 1e-6;       ///< by which every entry of x moves, up or down  [unit of x]
    double tolerance = 1e-7;  ///< of the directional derivative, relative to ‖grad_x‖
    int directions = 8;
    std::uint64_t seed = 1;
};

/// Holds an analytic gradient against central differences along random directions d with entries ±1:
///   grad_x · d = (loss(x + s d) − loss(x − s d)) / 2s  + O(s²)
/// `loss` maps a matrix or vector like x to a double; grad_x has the shape of x and must not be zero, since a
/// vanishing gradient of a loss that never left its plateau would agree with its differences.
template <class Loss, class X, class Gradient>
void require_gradient(
    Location where, const char* expression, Loss&& loss, const X& x, const Gradient& grad_x,
    const GradientOptions& options = {}) {
    const std::string text = std::string("CHECK_GRADIENT(") + expression + ")\n    ";
    const typename X::PlainObject x0 = x;
    const typename Gradient::PlainObject grad = grad_x;
    if (x0.rows() != grad.rows() || x0.cols() != grad.cols()) fail(where, text + "x and grad_x differ in shape");
    const double scale = grad.norm();
    if (!(scale > 0.0) || !std::isfinite(scale)) fail(where, text + "norm of the gradient is " + print(scale));

    Random random(options.seed);
    for (int direction = 0; direction < options.directions; ++direction) {
        typename X::PlainObject d = x0;
        for (Eigen::Index i = 0; i < d.size(); ++i) d.data()[i] = random.uniform() < 0.0 ? -1.0 : 1.0;
        const double above = loss(typename X::PlainObject(x0 + options.step * d));
        const double below = loss(typename X::PlainObject(x0 - options.step * d));
        const double numeric = (above - below) / (2.0 * options.step);
        const double analytic = grad.cwiseProduct(d).sum();
        const double error = std::abs(analytic - numeric) / scale;
        if (!(error <= options.tolerance)) {
            fail(
                where, text + "direction " + print(direction) + ": analytic " + print(analytic) + ", numeric " +
                           print(numeric) + ", error " + print(error) + " of the gradient's norm, tolerance " +
                           print(options.tolerance));
        }
    }
}

}  // namespace check

#define CHECK_JOIN_EXPANDED(a, b) a##b
#define CHECK_JOIN(a, b) CHECK_JOIN_EXPANDED(a, b)
#define CHECK_HERE (::check::Location{__FILE__, __LINE__})

#define TEST(name)                                                                                                    \
    static void test_##name();                                                                                        \
    [[maybe_unused]] static const bool registered_##name = ::check::register_test({#name, CHECK_HERE, &test_##name}); \
    static void test_##name()

#define NOTE(expression)            \
    const ::check::Note CHECK_JOIN( \
        note_, __LINE__)([&](std::ostream& out) { out << #expression << " = " << ::check::print(expression); })

// CHECK(condition), CHECK_NEAR(actual, expected, tolerance), CHECK_THROWS(expression, Exception),
// CHECK_THROWS_WITH(expression, Exception, message_part), CHECK_GRADIENT(loss, x, grad_x[, {step, tolerance, ...}])
#define CHECK(...) ::check::require(CHECK_HERE, #__VA_ARGS__, ::check::Capture{} << __VA_ARGS__)
#define CHECK_NEAR(...) ::check::require_near(CHECK_HERE, #__VA_ARGS__, __VA_ARGS__)
#define CHECK_THROWS(expression, Exception) CHECK_THROWS_WITH(expression, Exception, "")
#define CHECK_THROWS_WITH(expression, Exception, message_part) \
    ::check::require_throws<Exception>(                        \
        CHECK_HERE, #expression ", " #Exception, [&] { static_cast<void>(expression); }, message_part)
#define CHECK_GRADIENT(...) ::check::require_gradient(CHECK_HERE, #__VA_ARGS__, __VA_ARGS__)
