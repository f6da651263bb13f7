#pragma once

#include "collision/ccd.hpp"
#include "fixtures.hpp"
#include "geometry/distance.hpp"

namespace fixtures {

/// A vertex and a polygon, or two edges, as points at the start and the end of the motion.
struct Motion {
    std::vector<Vec3> begin, end;
    bool is_edges;

    std::vector<Vec3> at(double s) const {
        std::vector<Vec3> points;
        for (std::size_t k = 0; k < begin.size(); ++k) points.push_back(begin[k] + s * (end[k] - begin[k]));
        return points;
    }
    double distance(double s) const {
        const std::vector<Vec3> x = at(s);
        if (is_edges) return closest_edge_edge(x[0], x[1], x[2], x[3]).distance();
        const int count = static_cast<int>(x.size()) - 1;
        return closest_vertex_polygon(x[0], {&x[1], count, polygon_normal(&x[1], count)}).distance();
    }
    CcdResult ccd(const CcdOptions& options) const {
        if (is_edges) return edge_edge_ccd(&begin[0], &end[0], &begin[2], &end[2], options);
        return vertex_polygon_ccd(begin[0], end[0], &begin[1], &end[1], static_cast<int>(begin.size()) - 1, options);
    }
    double toi(const CcdOptions& options) const { return ccd(options).toi; }
};

}  // namespace fixtures
