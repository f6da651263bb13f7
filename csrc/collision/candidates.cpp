#include "collision/candidates.hpp"

#include <Eigen/Geometry>
#include <algorithm>

namespace diffsim {
namespace {

Box swept_box_of(const Box& box_body, const SweptMesh& swept) {
    Box box = transformed(box_body, swept.sweep.begin);
    box.include(transformed(box_body, swept.sweep.end));
    box.inflate(swept.reach);
    return box;
}

Box vertex_box(const SweptMesh& swept, int vertex) {
    Box box;
    if (swept.begin != nullptr) {
        box.include(swept.begin[vertex]);
        box.include(swept.end[vertex]);
    } else {
        box.include(swept.sweep.begin * swept.mesh->vertices[vertex]);
        box.include(swept.sweep.end * swept.mesh->vertices[vertex]);
    }
    box.inflate(swept.reach);
    return box;
}

const BoxTree& tree_of(const SweptMesh& swept) { return swept.tree != nullptr ? *swept.tree : swept.mesh->tree; }

Box node_box(const SweptMesh& swept, int node) {
    return swept.tree != nullptr ? swept.tree->nodes[node].box : swept_box_of(swept.mesh->tree.nodes[node].box, swept);
}

Box edge_box(const SweptMesh& swept, int edge) {
    Box box = vertex_box(swept, swept.mesh->edges[edge].p0);
    box.include(vertex_box(swept, swept.mesh->edges[edge].p1));
    return box;
}

Box patch_box(const SweptMesh& swept, int patch) {
    Box box;
    for (int v : swept.mesh->patches[patch].vertices) box.include(vertex_box(swept, v));
    return box;
}

/// Whether vertices of a cell are to be held against a patch. A sphere's or capsule's patch has no area: the edges
/// of a mesh cover it, and of two such bodies the vertices of the one with the smaller patch do.
bool patch_counts(const Patch& own, const Patch& other, ContactType type) {
    const std::size_t own_size = own.vertices.size(), other_size = other.vertices.size();
    if (other_size >= 3) return true;
    if (own_size >= 3) return false;
    return other_size == 2 || (own_size == 1 && type == ContactType::vertex_patch);
}

/// Vertices of one cell against the patch of the other.
void pair_vertices(
    const SweptMesh& a, const Cell& cell_a, const SweptMesh& b, const Cell& cell_b, ContactType type,
    std::vector<FeaturePair>& pairs) {
    if (cell_a.vertices.empty()) return;
    if (!patch_counts(a.mesh->patches[cell_a.patch], b.mesh->patches[cell_b.patch], type)) return;
    const Box box_b = patch_box(b, cell_b.patch);
    for (int v : cell_a.vertices) {
        if (!vertex_box(a, v).overlaps(box_b)) continue;
        if (type == ContactType::vertex_patch)
            pairs.push_back({type, v, cell_b.patch});
        else
            pairs.push_back({type, cell_b.patch, v});
    }
}

void pair_cells(
    const SweptMesh& a, const Cell& cell_a, const SweptMesh& b, const Cell& cell_b, std::vector<FeaturePair>& pairs) {
    pair_vertices(a, cell_a, b, cell_b, ContactType::vertex_patch, pairs);
    pair_vertices(b, cell_b, a, cell_a, ContactType::patch_vertex, pairs);
    for (int ea : cell_a.edges) {
        const Box box_a = edge_box(a, ea);
        for (int eb : cell_b.edges)
            if (box_a.overlaps(edge_box(b, eb))) pairs.push_back({ContactType::edge_edge, ea, eb});
    }
}

/// Calls visit_cells(cell_a, cell_b) for all pairs of cells whose swept boxes overlap.
template <typename VisitCells>
struct TreePairing {
    const SweptMesh& a;
    const SweptMesh& b;
    const VisitCells& visit_cells;

    void visit(int node_a, const Box& box_a, int node_b, const Box& box_b) {
        if (!box_a.overlaps(box_b)) return;
        const BoxTree::Node& na = tree_of(a).nodes[node_a];
        const BoxTree::Node& nb = tree_of(b).nodes[node_b];
        if (na.is_leaf() && nb.is_leaf()) {
            visit_cells(a.mesh->cells[na.item], b.mesh->cells[nb.item]);
        } else if (nb.is_leaf() || (!na.is_leaf() && na.box.half_extent().sum() >= nb.box.half_extent().sum())) {
            visit(na.left, node_box(a, na.left), node_b, box_b);
            visit(na.right, node_box(a, na.right), node_b, box_b);
        } else {
            visit(node_a, box_a, nb.left, node_box(b, nb.left));
            visit(node_a, box_a, nb.right, node_box(b, nb.right));
        }
    }
};

template <typename VisitCells>
void for_each_cell_pair(const SweptMesh& a, const SweptMesh& b, const VisitCells& visit_cells) {
    if (a.mesh->tree.empty() || b.mesh->tree.empty()) return;
    TreePairing<VisitCells>{a, b, visit_cells}.visit(0, swept_box(a), 0, swept_box(b));
}

/// Pairs of features of one mesh, of cells that overlap.
class SelfPairing {
public:
    SelfPairing(const SweptMesh& swept, std::vector<FeaturePair>& pairs)
        : m_swept(swept), m_nodes(tree_of(swept).nodes), m_pairs(pairs) {}

    void visit(int node) {
        const BoxTree::Node& n = m_nodes[node];
        if (n.is_leaf()) return;  // the features of one cell share vertices
        visit(n.left);
        visit(n.right);
        visit(n.left, n.right);
    }

private:
    void visit(int node_a, int node_b) {
        const BoxTree::Node &na = m_nodes[node_a], &nb = m_nodes[node_b];
        if (!na.box.overlaps(nb.box)) return;
        if (na.is_leaf() && nb.is_leaf()) {
            pair(m_swept.mesh->cells[na.item], m_swept.mesh->cells[nb.item]);
        } else if (nb.is_leaf() || (!na.is_leaf() && na.box.half_extent().sum() >= nb.box.half_extent().sum())) {
            visit(na.left, node_b);
            visit(na.right, node_b);
        } else {
            visit(node_a, nb.left);
            visit(node_a, nb.right);
        }
    }

    void pair(const Cell& cell_a, const Cell& cell_b) {
        const std::size_t first = m_pairs.size();
        pair_cells(m_swept, cell_a, m_swept, cell_b, m_pairs);
        const auto share = [&](const FeaturePair& pair) {
            const CollisionMesh& mesh = *m_swept.mesh;
            const auto in_patch = [&](int vertex, int patch) {
                const std::vector<int>& loop = mesh.patches[patch].vertices;
                return std::find(loop.begin(), loop.end(), vertex) != loop.end();
            };
            switch (pair.type) {
                case ContactType::vertex_patch:
                    return in_patch(pair.feature_a, pair.feature_b);
                case ContactType::patch_vertex:
                    return in_patch(pair.feature_b, pair.feature_a);
                case ContactType::edge_edge:
                    break;
            }
            const Edge &a = mesh.edges[pair.feature_a], &b = mesh.edges[pair.feature_b];
            return a.p0 == b.p0 || a.p0 == b.p1 || a.p1 == b.p0 || a.p1 == b.p1;
        };
        m_pairs.erase(
            std::remove_if(m_pairs.begin() + static_cast<std::ptrdiff_t>(first), m_pairs.end(), share), m_pairs.end());
    }

    const SweptMesh& m_swept;
    const std::vector<BoxTree::Node>& m_nodes;
    std::vector<FeaturePair>& m_pairs;
};

/// Whether a side of polygon p goes through polygon q, convex and planar, with this normal.
bool side_crosses(const std::vector<Vec3>& p, const std::vector<Vec3>& q, const Vec3& q_normal) {
    for (std::size_t k = 0; k < p.size(); ++k) {
        const Vec3 &from = p[k], &to = p[(k + 1) % p.size()];
        const double height0 = q_normal.dot(from - q[0]), height1 = q_normal.dot(to - q[0]);
        if (!(height0 * height1 < 0.0)) continue;
        const Vec3 point = from + height0 / (height0 - height1) * (to - from);
        bool inside = true;
        for (std::size_t l = 0; l < q.size() && inside; ++l)
            inside = q_normal.dot((q[(l + 1) % q.size()] - q[l]).cross(point - q[l])) >= 0.0;
        if (inside) return true;
    }
    return false;
}

}  // namespace

BoxTree refitted_tree(const SweptMesh& swept) {
    BoxTree tree = swept.mesh->tree;
    for (std::size_t k = tree.nodes.size(); k-- > 0;) {  // children follow their parents
        BoxTree::Node& node = tree.nodes[k];
        if (node.is_leaf()) {
            node.box = patch_box(swept, swept.mesh->cells[node.item].patch);
        } else {
            node.box = tree.nodes[node.left].box;
            node.box.include(tree.nodes[node.right].box);
        }
    }
    return tree;
}

Box swept_box(const SweptMesh& swept) { return node_box(swept, 0); }

void collect_feature_pairs(const SweptMesh& a, const SweptMesh& b, std::vector<FeaturePair>& pairs) {
    for_each_cell_pair(a, b, [&](const Cell& cell_a, const Cell& cell_b) { pair_cells(a, cell_a, b, cell_b, pairs); });
}

void collect_self_pairs(const SweptMesh& swept, std::vector<FeaturePair>& pairs) {
    if (!tree_of(swept).empty()) SelfPairing(swept, pairs).visit(0);
}

bool meshes_cross(const CollisionMesh& mesh_a, const Pose& pose_a, const CollisionMesh& mesh_b, const Pose& pose_b) {
    const auto corners = [](const CollisionMesh& mesh, const Patch& patch, const Pose& pose) {
        std::vector<Vec3> result;
        for (int v : patch.vertices) result.push_back(pose * mesh.vertices[v]);
        return result;
    };
    bool cross = false;
    const SweptMesh a{&mesh_a, {pose_a, pose_a}, 0.0}, b{&mesh_b, {pose_b, pose_b}, 0.0};
    for_each_cell_pair(a, b, [&](const Cell& cell_a, const Cell& cell_b) {
        const Patch &patch_a = mesh_a.patches[cell_a.patch], &patch_b = mesh_b.patches[cell_b.patch];
        if (cross || patch_a.vertices.size() < 3 || patch_b.vertices.size() < 3) return;
        const std::vector<Vec3> p = corners(mesh_a, patch_a, pose_a), q = corners(mesh_b, patch_b, pose_b);
        cross = side_crosses(p, q, pose_b.R * patch_b.normal) || side_crosses(q, p, pose_a.R * patch_a.normal);
    });
    return cross;
}

void collect_vertices_below(const SweptMesh& swept, double height, std::vector<int>& vertices) {
    if (swept_box(swept).lower.z() > height) return;
    if (swept.begin != nullptr) {
        for (int v : swept.mesh->active_vertices)
            if (std::min(swept.begin[v].z(), swept.end[v].z()) <= height + swept.reach) vertices.push_back(v);
        return;
    }
    const Vec3 up0 = swept.sweep.begin.R.row(2), up1 = swept.sweep.end.R.row(2);
    const double limit0 = height + swept.reach - swept.sweep.begin.t.z();
    const double limit1 = height + swept.reach - swept.sweep.end.t.z();
    for (int v : swept.mesh->active_vertices) {
        const Vec3& x = swept.mesh->vertices[v];
        if (up0.dot(x) <= limit0 || up1.dot(x) <= limit1) vertices.push_back(v);
    }
}

}  // namespace diffsim
