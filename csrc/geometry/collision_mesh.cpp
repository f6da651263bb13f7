#include "geometry/collision_mesh.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <stdexcept>

namespace diffsim {
namespace {

using Triangle = Eigen::Vector3i;

/// Vertices this far off a common plane, relative to the mesh's size, still count as coplanar: rounding
/// of single precision files is below it, and the error it makes in a distance is far below any
/// thickness (1e-3 of the size by default).
constexpr double kCoplanarTolerance = 1e-7;

std::pair<int, int> edge_key(int i, int j) { return {std::min(i, j), std::max(i, j)}; }

/// Makes patches of the faces of one mesh.
class PatchBuilder {
public:
    PatchBuilder(
        const std::vector<Vec3>& vertices, const std::vector<Triangle>& triangles, const EdgeFaces& edge_faces,
        double size)
        : m_vertices(vertices),
          m_triangles(triangles),
          m_edge_faces(edge_faces),
          m_tolerance(kCoplanarTolerance * size) {
        for (const Triangle& f : triangles)
            m_normals.push_back((vertices[f[1]] - vertices[f[0]]).cross(vertices[f[2]] - vertices[f[0]]).normalized());
    }

    std::vector<Patch> one_per_face() const {
        std::vector<Patch> patches;
        for (std::size_t f = 0; f < m_triangles.size(); ++f)
            patches.push_back({{m_triangles[f][0], m_triangles[f][1], m_triangles[f][2]}, m_normals[f]});
        return patches;
    }

    /// Grow convex coplanar patches.
    std::vector<Patch> merged() const {
        std::vector<Patch> patches;
        std::vector<char> used(m_triangles.size(), 0);
        for (int seed = 0; seed < static_cast<int>(m_triangles.size()); ++seed) {
            if (used[seed]) continue;
            used[seed] = 1;
            Patch patch{{m_triangles[seed][0], m_triangles[seed][1], m_triangles[seed][2]}, m_normals[seed]};
            while (grow(patch, used)) {
            }
            patches.push_back(std::move(patch));
        }
        return patches;
    }

    bool is_flat(const std::vector<int>& faces) const {
        return faces.size() == 2 && coplanar(faces[0], m_vertices[m_triangles[faces[0]][0]], m_normals[faces[0]]) &&
               coplanar(faces[1], m_vertices[m_triangles[faces[0]][0]], m_normals[faces[0]]);
    }

    Vec3 outward(const std::vector<int>& faces) const {
        if (faces.size() != 2) return Vec3::Zero();
        return m_normals[faces[0]] + m_normals[faces[1]];
    }

private:
    bool coplanar(int face, const Vec3& origin, const Vec3& normal) const {
        if (m_normals[face].dot(normal) < 0.5) return false;
        for (int k = 0; k < 3; ++k)
            if (std::abs(normal.dot(m_vertices[m_triangles[face][k]] - origin)) > m_tolerance) return false;
        return true;
    }

    bool convex(const std::vector<int>& loop, const Vec3& normal) const {
        const int count = static_cast<int>(loop.size());
        for (int k = 0; k < count; ++k) {
            const Vec3& previous = m_vertices[loop[(k + count - 1) % count]];
            const Vec3& here = m_vertices[loop[k]];
            const Vec3& next = m_vertices[loop[(k + 1) % count]];
            const Vec3 in = here - previous, out = next - here;
            if (normal.dot(in.cross(out)) < -kCoplanarTolerance * in.norm() * out.norm()) return false;
        }
        return true;
    }

    /// Add one neighbouring face to the patch; false if none fits.
    bool grow(Patch& patch, std::vector<char>& used) const {
        const int count = static_cast<int>(patch.vertices.size());
        for (int k = 0; k < count; ++k) {
            const int i = patch.vertices[k], j = patch.vertices[(k + 1) % count];
            const auto found = m_edge_faces.find(edge_key(i, j));
            if (found == m_edge_faces.end() || !is_flat(found->second)) continue;
            for (int face : found->second) {
                if (used[face] || !coplanar(face, m_vertices[patch.vertices[0]], patch.normal)) continue;
                const Triangle& t = m_triangles[face];
                const int apex = t[0] != i && t[0] != j ? t[0] : t[1] != i && t[1] != j ? t[1] : t[2];
                if (std::find(patch.vertices.begin(), patch.vertices.end(), apex) != patch.vertices.end()) continue;
                std::vector<int> loop = patch.vertices;
                loop.insert(loop.begin() + k + 1, apex);
                if (!convex(loop, patch.normal)) continue;
                patch.vertices = std::move(loop);
                used[face] = 1;
                return true;
            }
        }
        return false;
    }

    const std::vector<Vec3>& m_vertices;
    const std::vector<Triangle>& m_triangles;
    const EdgeFaces& m_edge_faces;
    double m_tolerance;  // [m]
    std::vector<Vec3> m_normals;
};

Box cell_box(const CollisionMesh& mesh, const Cell& cell) {
    Box box;
    if (cell.patch >= 0)
        for (int v : mesh.patches[cell.patch].vertices) box.include(mesh.vertices[v]);
    for (int v : cell.vertices) box.include(mesh.vertices[v]);
    for (int e : cell.edges) {
        box.include(mesh.vertices[mesh.edges[e].p0]);
        box.include(mesh.vertices[mesh.edges[e].p1]);
    }
    return box;
}

/// Cells of a surface: one per patch, each vertex and edge in the first patch that has it.
void build_cells(CollisionMesh& mesh) {
    std::vector<char> vertex_taken(mesh.vertices.size(), 1);
    std::map<std::pair<int, int>, int> edge_ids;
    for (int e = 0; e < static_cast<int>(mesh.edges.size()); ++e) {
        edge_ids[edge_key(mesh.edges[e].p0, mesh.edges[e].p1)] = e;
        // A vertex all of whose edges are flat lies inside a flat spot and touches nothing first.
        vertex_taken[mesh.edges[e].p0] = vertex_taken[mesh.edges[e].p1] = 0;
    }
    std::vector<char> edge_taken(mesh.edges.size(), 0);
    for (int p = 0; p < static_cast<int>(mesh.patches.size()); ++p) {
        Cell cell;
        cell.patch = p;
        const std::vector<int>& loop = mesh.patches[p].vertices;
        for (std::size_t k = 0; k < loop.size(); ++k) {
            if (!vertex_taken[loop[k]]) {
                vertex_taken[loop[k]] = 1;
                cell.vertices.push_back(loop[k]);
            }
            const auto found = edge_ids.find(edge_key(loop[k], loop[(k + 1) % loop.size()]));
            if (found != edge_ids.end() && !edge_taken[found->second]) {
                edge_taken[found->second] = 1;
                cell.edges.push_back(found->second);
            }
        }
        mesh.cells.push_back(std::move(cell));
    }
}

}  // namespace

EdgeFaces collect_edge_faces(const std::vector<Triangle>& triangles) {
    EdgeFaces result;
    for (int f = 0; f < static_cast<int>(triangles.size()); ++f)
        for (int k = 0; k < 3; ++k) result[edge_key(triangles[f][k], triangles[f][(k + 1) % 3])].push_back(f);
    return result;
}

CollisionMesh build_collision_mesh(std::vector<Vec3> vertices, const std::vector<Triangle>& triangles, Faces faces) {
    const int vertex_count = static_cast<int>(vertices.size());
    CollisionMesh mesh;
    mesh.vertices = std::move(vertices);
    Box bounds;
    for (const Vec3& x : mesh.vertices) {
        mesh.radius = std::max(mesh.radius, x.norm());
        bounds.include(x);
    }
    if (triangles.empty()) {
        if (vertex_count != 1 && vertex_count != 2)
            throw std::invalid_argument("a body without faces must be one vertex (a point) or two (a segment)");
        Cell cell;
        cell.patch = 0;
        mesh.patches.push_back({{}, Vec3::Zero()});
        for (int v = 0; v < vertex_count; ++v) {
            cell.vertices.push_back(v);
            mesh.patches[0].vertices.push_back(v);
        }
        if (vertex_count == 2) {
            mesh.edges.push_back({0, 1, Vec3::Zero()});
            cell.edges.push_back(0);
        }
        mesh.cells.push_back(std::move(cell));
    } else {
        for (const Triangle& t : triangles)
            if (t.minCoeff() < 0 || t.maxCoeff() >= vertex_count)
                throw std::invalid_argument("face index out of range");
        const EdgeFaces edge_faces = collect_edge_faces(triangles);
        const PatchBuilder builder(mesh.vertices, triangles, edge_faces, (bounds.upper - bounds.lower).norm());
        const bool separate = faces == Faces::separate;
        mesh.patches = separate ? builder.one_per_face() : builder.merged();
        mesh.closed = true;
        for (const auto& [key, around] : edge_faces) {
            mesh.closed = mesh.closed && around.size() == 2;
            if (separate || !builder.is_flat(around))
                mesh.edges.push_back({key.first, key.second, builder.outward(around)});
        }
        build_cells(mesh);
    }
    std::vector<Box> boxes;
    for (const Cell& cell : mesh.cells) boxes.push_back(cell_box(mesh, cell));
    mesh.tree = build_box_tree(boxes);
    for (const Cell& cell : mesh.cells)
        mesh.active_vertices.insert(mesh.active_vertices.end(), cell.vertices.begin(), cell.vertices.end());
    std::sort(mesh.active_vertices.begin(), mesh.active_vertices.end());
    return mesh;
}

}  // namespace diffsim
