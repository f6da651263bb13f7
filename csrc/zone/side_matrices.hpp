#pragma once

#include "zone/contact_term.hpp"

/// Matrices over the sides of contacts, as what acts on the coordinates of a zone.
namespace diffsim {

/// A sum of matrices, not symmetric, each over the sides of one contact. Those of contacts of the same bodies
/// that follow each other are one.
class SideMatrices {
public:
    void clear() { m_parts.clear(); }
    bool empty() const { return m_parts.empty(); }

    /// Returns the number of the matrix that it went to.
    template <class Term>
    std::size_t add(const Term& term, const SmallMatrix& matrix) {
        if (!m_parts.empty() && m_parts.back().is_of(term))
            m_parts.back().matrix += matrix;
        else
            m_parts.push_back({term.sides, term.side_count, matrix});
        return m_parts.size() - 1;
    }
    SmallMatrix& operator[](std::size_t part) { return m_parts[part].matrix; }

    /// sum += factor * matrix * in; rows and columns of what does not yield count as zero.
    void add_product(const Zone& zone, double factor, const Coordinates& in, Coordinates& sum) const;
    /// The same of its transpose.
    void add_transposed_product(const Zone& zone, double factor, const Coordinates& in, Coordinates& sum) const;

private:
    struct Part {
        std::array<ContactTerm::Side, 2> sides;
        int side_count;
        SmallMatrix matrix;

        template <class Term>
        bool is_of(const Term& term) const {
            if (term.side_count != side_count || sides[0].body < 0 || term.sides[0].body != sides[0].body) return false;
            return side_count == 1 || (sides[1].body >= 0 && term.sides[1].body == sides[1].body);
        }
        template <class BodyPart, class NodePart>
        void for_each(const BodyPart& body_part, const NodePart& node_part) const {
            visit_sides(sides, side_count, body_part, node_part);
        }
    };
    std::vector<Part> m_parts;
};

}  // namespace diffsim
