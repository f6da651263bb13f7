#include "math/nested_dissection.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cstddef>
#include <limits>
#include <utility>

namespace diffsim {
namespace {

// Measured on sheets of 21 x 21 to 151 x 151 nodes, flat, folded and lying on bodies, and on stacks and heaps of
// bodies. Half or twice as much changes the cost of an elimination by a few percent, seldom by a tenth.
constexpr int kSmallPart = 30;        ///< vertices of a part that is cut no further
constexpr double kLargestSide = 0.7;  ///< of a cut, as part of the whole: bounds the depth of the dissection
constexpr double kHubDegree = 10.0;   ///< times the mean number of neighbours
constexpr int kPasses = 4;            ///< of the refinement, at most
constexpr int kPatience = 40;         ///< moves of a pass without a better separator

constexpr int kLandmarks = 4;

/// Sums of distances to the landmarks that grow from one side of the graph to the other. On a square whose corners are
/// the landmarks, differences of two lead along its diagonals, sums of two differences along its sides.
constexpr int kDirections[][kLandmarks] = {
    {1, -1, 0, 0}, {1, 1, -1, -1}, {1, -1, 1, -1}, {1, -1, -1, 1}, {0, 0, 1, -1},
    {1, 0, -1, 0}, {1, 0, 0, -1},  {0, 1, -1, 0},  {0, 1, 0, -1},
};

constexpr int kNowhere = std::numeric_limits<int>::max();
constexpr double kNoCut = std::numeric_limits<double>::infinity();

/// Where a vertex of the part being cut stands.
enum Side : signed char { kFirst = 0, kSecond = 1, kSeparator = 2, kOutside = 3 };

/// Weights of the sides and of what separates them.
struct Balance {
    std::array<int, 3> weight = {0, 0, 0};

    /// The separator's weight over the product of the sides': the smaller the better.
    double quotient() const {
        const double first = weight[kFirst], second = weight[kSecond], separator = weight[kSeparator];
        const double limit = kLargestSide * (first + second + separator);
        if (weight[kFirst] == 0 || weight[kSecond] == 0 || first > limit || second > limit) return kNoCut;
        return separator / (first * second);
    }
};

class Dissector {
public:
    Dissector(const Neighbors& neighbors, const std::vector<int>& weights, const std::vector<int>& order)
        : m_neighbors(neighbors),
          m_weights(weights),
          m_order(order),
          m_side(order.size(), kOutside),
          m_queue(order.size()),
          m_sequence(order.size()),
          m_best_sequence(order.size()),
          m_key(order.size()),
          m_place(order.size(), kNowhere),
          m_entering(order.size()),
          m_gain(order.size()),
          m_locked(order.size(), 0) {
        for (std::vector<int>& distance : m_distance) distance.resize(order.size());
    }

    Dissection run() {
        const std::vector<int> given = m_order;
        const int body = set_hubs_aside();
        m_parts.push_back({0, body});
        while (!m_parts.empty()) {
            const Range part = m_parts.back();
            m_parts.pop_back();
            for (const Range& piece : split_into_connected(part))
                if (!cut(piece)) m_kept.push_back(piece);
        }
        std::vector<int>& rank = m_key;
        for (std::size_t k = 0; k < given.size(); ++k) rank[given[k]] = static_cast<int>(k);
        for (const Range& range : m_kept) {
            std::sort(m_order.begin() + range.begin, m_order.begin() + range.end, [&](int a, int b) {
                return rank[a] < rank[b];
            });
        }
        return {std::move(m_order), std::move(m_cuts)};
    }

private:
    struct Range {
        int begin, end;
    };

    template <class Visit>
    void each_neighbor(int v, const Visit& visit) const {
        for (int k = m_neighbors.start[v]; k < m_neighbors.start[v + 1]; ++k) visit(m_neighbors.vertex[k]);
    }

    /// Vertices near to all others, like a body that much of a cloth lies on, would make all distances the same.
    int set_hubs_aside() {
        const double mean = static_cast<double>(m_neighbors.vertex.size()) / static_cast<double>(m_order.size());
        const auto hubs = std::stable_partition(m_order.begin(), m_order.end(), [&](int v) {
            return m_neighbors.start[v + 1] - m_neighbors.start[v] <= kHubDegree * mean;
        });
        return static_cast<int>(hubs - m_order.begin());
    }

    /// Each piece in one piece, breadth first.
    std::vector<Range> split_into_connected(const Range& part) {
        for (int k = part.begin; k < part.end; ++k) m_side[m_order[k]] = kSecond;  // not yet found
        std::vector<Range> pieces;
        int end = part.begin;
        for (int k = part.begin; k < part.end; ++k) {
            if (m_side[m_order[k]] != kSecond) continue;
            const int begin = end;
            m_side[m_order[k]] = kOutside;
            m_queue[end++] = m_order[k];
            for (int q = begin; q < end; ++q) {
                each_neighbor(m_queue[q], [&](int u) {
                    if (m_side[u] != kSecond) return;
                    m_side[u] = kOutside;
                    m_queue[end++] = u;
                });
            }
            pieces.push_back({begin, end});
        }
        std::copy(m_queue.begin() + part.begin, m_queue.begin() + part.end, m_order.begin() + part.begin);
        return pieces;
    }

    /// False if the piece stays as it is.
    bool cut(const Range& piece) {
        if (piece.end - piece.begin <= kSmallPart) return false;
        measure_distances(piece);
        if (!find_separator(piece)) return false;
        refine_separator(piece);

        std::array<int, 3> count = {0, 0, 0};
        for (int k = piece.begin; k < piece.end; ++k) ++count[m_side[m_order[k]]];
        const int second = piece.begin + count[kFirst], separator = second + count[kSecond];
        std::array<int, 3> next = {piece.begin, second, separator};
        std::copy(m_order.begin() + piece.begin, m_order.begin() + piece.end, m_queue.begin() + piece.begin);
        for (int k = piece.begin; k < piece.end; ++k) {
            const int v = m_queue[k];
            m_order[next[m_side[v]]++] = v;
            m_side[v] = kOutside;
        }
        m_cuts.push_back({piece.begin, second, separator, piece.end});
        m_kept.push_back({separator, piece.end});
        m_parts.push_back({piece.begin, second});
        m_parts.push_back({second, separator});
        return true;
    }

    /// From landmarks far from each other: first the vertex found last, then that farthest from all landmarks so far.
    void measure_distances(const Range& piece) {
        int landmark = m_order[piece.end - 1];
        for (int i = 0; i < kLandmarks; ++i) {
            measure_distances(piece, landmark, m_distance[i]);
            int farthest = -1;
            for (int k = piece.begin; k < piece.end; ++k) {
                const int v = m_order[k];
                int nearest = m_distance[0][v];
                for (int j = 1; j <= i; ++j) nearest = std::min(nearest, m_distance[j][v]);
                if (nearest <= farthest) continue;
                farthest = nearest;
                landmark = v;
            }
        }
    }

    void measure_distances(const Range& piece, int landmark, std::vector<int>& distance) {
        // Those of other vertices are not negative, which keeps the search inside the piece.
        for (int k = piece.begin; k < piece.end; ++k) distance[m_order[k]] = -1;
        int end = 0;
        distance[landmark] = 0;
        m_queue[end++] = landmark;
        for (int q = 0; q < end; ++q) {
            const int v = m_queue[q];
            each_neighbor(v, [&](int u) {
                if (distance[u] >= 0) return;
                distance[u] = distance[v] + 1;
                m_queue[end++] = u;
            });
        }
        assert(end == piece.end - piece.begin);
    }

    /// Sweeps over the piece in several directions; behind the front is the first side, and the vertices next to it
    /// separate it from the second.
    bool find_separator(const Range& piece) {
        double best = kNoCut;
        int best_count = 0;
        for (const auto& direction : kDirections) {
            sort_along(piece, direction);
            bool better = false;
            Balance balance = sweep(piece);
            for (int k = 0; k < piece.end - piece.begin; ++k) {
                const int weight = m_weights[m_sequence[k]];
                balance.weight[kFirst] += weight;
                balance.weight[kSecond] -= weight + m_entering[k];
                balance.weight[kSeparator] += m_entering[k];
                const double quotient = balance.quotient();
                if (!(quotient < best)) continue;
                best = quotient;
                best_count = k + 1;
                better = true;
            }
            if (better) m_best_sequence.swap(m_sequence);
        }
        for (int k = piece.begin; k < piece.end; ++k) m_place[m_order[k]] = kNowhere;
        if (best == kNoCut) return false;
        for (int k = 0; k < piece.end - piece.begin; ++k)
            m_side[m_best_sequence[k]] = k < best_count ? kFirst : kSecond;
        for (int k = 0; k < best_count; ++k) {
            each_neighbor(m_best_sequence[k], [&](int u) {
                if (m_side[u] == kSecond) m_side[u] = kSeparator;
            });
        }
        return true;
    }

    /// m_sequence: the piece by increasing keys; m_place: where each vertex stands in it.
    void sort_along(const Range& piece, const int (&direction)[kLandmarks]) {
        int lowest = std::numeric_limits<int>::max(), highest = std::numeric_limits<int>::min();
        for (int k = piece.begin; k < piece.end; ++k) {
            const int v = m_order[k];
            int key = 0;
            for (int i = 0; i < kLandmarks; ++i) key += direction[i] * m_distance[i][v];
            m_key[v] = key;
            lowest = std::min(lowest, key);
            highest = std::max(highest, key);
        }
        m_bucket.assign(static_cast<std::size_t>(highest - lowest) + 2, 0);
        for (int k = piece.begin; k < piece.end; ++k) ++m_bucket[m_key[m_order[k]] - lowest + 1];
        for (std::size_t b = 1; b < m_bucket.size(); ++b) m_bucket[b] += m_bucket[b - 1];
        for (int k = piece.begin; k < piece.end; ++k) {
            const int v = m_order[k];
            m_place[v] = m_bucket[m_key[v] - lowest]++;
            m_sequence[m_place[v]] = v;
        }
    }

    /// m_entering[k]: by how much the separator gets heavier when the front passes the vertex at place k. Each vertex
    /// is in it from when the first of its neighbours is passed until it is passed itself. Returns the balance before.
    Balance sweep(const Range& piece) {
        const int count = piece.end - piece.begin;
        std::fill_n(m_entering.begin(), count, 0);
        Balance balance;
        for (int k = 0; k < count; ++k) {
            const int v = m_sequence[k];
            int first = k;
            each_neighbor(v, [&](int u) { first = std::min(first, m_place[u]); });
            m_entering[first] += m_weights[v];
            m_entering[k] -= m_weights[v];
            balance.weight[kSecond] += m_weights[v];
        }
        return balance;
    }

    /// Moves single vertices of the separator to a side, whose neighbours on the other side then enter it. Always the
    /// best move, even one for the worse, each vertex once; then back to the best separator seen; and all over again
    /// [fiduccia1982linear, hendrickson1998improving].
    void refine_separator(const Range& piece) {
        for (int pass = 0; pass < kPasses; ++pass)
            if (!refine_once(piece)) return;
    }

    struct Move {
        int place = -1;  ///< in m_separator
        Side to = kFirst;
        Balance balance;  ///< afterwards
        double quotient = kNoCut;
    };

    bool refine_once(const Range& piece) {
        Balance balance;
        m_separator.clear();
        m_changes.clear();
        for (int k = piece.begin; k < piece.end; ++k) {
            const int v = m_order[k];
            balance.weight[m_side[v]] += m_weights[v];
            if (m_side[v] == kSeparator) m_separator.push_back(v);
        }
        for (const int v : m_separator) measure_gains(v);

        const double before = balance.quotient();
        double best = before;
        std::size_t best_changes = 0;
        m_moved.clear();
        for (int moves = 0; moves < kPatience; ++moves) {
            const Move move = find_move(balance);
            if (move.place < 0) break;
            make_move(move);
            balance = move.balance;
            if (move.quotient < best) {
                best = move.quotient;
                best_changes = m_changes.size();
                moves = -1;
            }
        }
        for (; m_changes.size() > best_changes; m_changes.pop_back())
            m_side[m_changes.back().first] = m_changes.back().second;
        for (const int v : m_moved) m_locked[v] = 0;
        return best < before;
    }

    /// m_gain[v][side]: by how much the separator gets heavier if v moves to that side.
    void measure_gains(int v) {
        m_gain[v] = {-m_weights[v], -m_weights[v]};
        each_neighbor(v, [&](int u) {
            if (m_side[u] == kFirst || m_side[u] == kSecond) m_gain[v][1 - m_side[u]] += m_weights[u];
        });
    }

    Move find_move(const Balance& balance) const {
        Move best;
        for (int place = 0; place < static_cast<int>(m_separator.size()); ++place) {
            const int v = m_separator[place];
            if (m_locked[v]) continue;
            for (const Side to : {kFirst, kSecond}) {
                Move move{place, to, balance, 0.0};
                move.balance.weight[to] += m_weights[v];
                move.balance.weight[1 - to] -= m_gain[v][to] + m_weights[v];
                move.balance.weight[kSeparator] += m_gain[v][to];
                move.quotient = move.balance.quotient();
                if (move.quotient < best.quotient) best = move;
            }
        }
        return best;
    }

    void make_move(const Move& move) {
        const int v = m_separator[move.place];
        m_separator[move.place] = m_separator.back();
        m_separator.pop_back();
        m_locked[v] = 1;
        m_moved.push_back(v);
        m_changes.emplace_back(v, kSeparator);
        m_side[v] = move.to;
        const Side other = move.to == kFirst ? kSecond : kFirst;
        each_neighbor(v, [&](int u) {
            if (m_side[u] == kSeparator) {
                m_gain[u][other] += m_weights[v];
            } else if (m_side[u] == other) {
                m_changes.emplace_back(u, other);
                m_side[u] = kSeparator;
                m_separator.push_back(u);
                measure_gains(u);
                each_neighbor(u, [&](int w) {
                    if (m_side[w] == kSeparator) m_gain[w][move.to] -= m_weights[u];
                });
            }
        });
    }

    const Neighbors m_neighbors;
    const std::vector<int>& m_weights;
    std::vector<int> m_order;  ///< becomes the result
    std::vector<Cut> m_cuts;
    std::vector<Range> m_parts, m_kept;  ///< yet to be cut; that keep the given order
    std::vector<Side> m_side;            ///< kOutside but in the piece being cut
    std::array<std::vector<int>, kLandmarks> m_distance;
    std::vector<int> m_queue, m_sequence, m_best_sequence, m_key, m_bucket;
    std::vector<int> m_place;  ///< kNowhere but in the piece being cut
    std::vector<int> m_entering;
    std::vector<int> m_separator, m_moved;
    std::vector<std::array<int, 2>> m_gain;
    std::vector<char> m_locked;
    std::vector<std::pair<int, Side>> m_changes;  ///< vertices and the sides they left
};

}  // namespace

Dissection nested_dissection(
    const Neighbors& neighbors, const std::vector<int>& weights, const std::vector<int>& order) {
    if (order.empty()) return {};
    return Dissector(neighbors, weights, order).run();
}

}  // namespace diffsim
