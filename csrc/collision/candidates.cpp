#include "collision/candidates.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "geometry/distance.hpp"

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

Box edge_box(const SweptBoxes& boxes, int edge) {
    const Edge& ends = boxes.swept().mesh->edges[edge];
    Box box = boxes.vertex(ends.p0);
    box.include(boxes.vertex(ends.p1));
    return box;
}

Box patch_box(const SweptBoxes& boxes, int patch) {
    Box box;
    for (int v : boxes.swept().mesh->patches[patch].vertices) box.include(boxes.vertex(v));
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
    const SweptBoxes& a, const Cell& cell_a, const SweptBoxes& b, const Cell& cell_b, ContactType type,
    std::vector<FeaturePair>& pairs) {
    if (cell_a.vertices.empty()) return;
    if (!patch_counts(a.swept().mesh->patches[cell_a.patch], b.swept().mesh->patches[cell_b.patch], type)) return;
    const Box box_b = patch_box(b, cell_b.patch);
    for (int v : cell_a.vertices) {
        if (!a.vertex(v).overlaps(box_b)) continue;
        if (type == ContactType::vertex_patch)
            pairs.push_back({type, v, cell_b.patch});
        else
            pairs.push_back({type, cell_b.patch, v});
    }
}

void pair_cells(
    const SweptBoxes& a, const Cell& cell_a, const SweptBoxes& b, const Cell& cell_b, std::vector<FeaturePair>& pairs) {
    pair_vertices(a, cell_a, b, cell_b, ContactType::vertex_patch, pairs);
    pair_vertices(b, cell_b, a, cell_a, ContactType::patch_vertex, pairs);
    for (int ea : cell_a.edges) {
        const Box box_a = edge_box(a, ea);
        for (int eb : cell_b.edges)
            if (box_a.overlaps(edge_box(b, eb))) pairs.push_back({ContactType::edge_edge, ea, eb});
    }
}

/// Down two trees at once: calls visit_cells(cell_a, cell_b) for all pairs of cells below two nodes whose swept boxes
/// overlap. `box_a(node)`, `box_b(node)`: swept.
template <typename BoxA, typename BoxB, typename VisitCells>
struct TreePairing {
    const SweptMesh& a;
    const SweptMesh& b;
    const BoxA& box_a;
    const BoxB& box_b;
    const VisitCells& visit_cells;

    void visit(int node_a, int node_b) const {
        if (!box_a(node_a).overlaps(box_b(node_b))) return;
        const BoxTree::Node& na = tree_of(a).nodes[node_a];
        const BoxTree::Node& nb = tree_of(b).nodes[node_b];
        if (na.is_leaf() && nb.is_leaf()) {
            visit_cells(a.mesh->cells[na.item], b.mesh->cells[nb.item]);
        } else if (nb.is_leaf() || (!na.is_leaf() && na.box.half_extent().sum() >= nb.box.half_extent().sum())) {
            visit(na.left, node_b);
            visit(na.right, node_b);
        } else {
            visit(node_a, nb.left);
            visit(node_a, nb.right);
        }
    }
};

/// Calls visit_cells(cell_a, cell_b) for all pairs of cells whose swept boxes overlap.
template <typename VisitCells>
void for_each_cell_pair(const SweptBoxes& a, const SweptBoxes& b, const VisitCells& visit_cells) {
    if (a.swept().mesh->tree.empty() || b.swept().mesh->tree.empty()) return;
    const auto box_a = [&](int node) -> const Box& { return a.node(node); };
    const auto box_b = [&](int node) -> const Box& { return b.node(node); };
    TreePairing<decltype(box_a), decltype(box_b), VisitCells>{a.swept(), b.swept(), box_a, box_b, visit_cells}.visit(
        0, 0);
}

/// All pairs of different cells below a node.
template <typename Pairing>
void visit_own_pairs(const Pairing& pairing, const BoxTree& tree, int node) {
    const BoxTree::Node& n = tree.nodes[node];
    if (n.is_leaf()) return;  // the features of one cell share vertices
    visit_own_pairs(pairing, tree, n.left);
    visit_own_pairs(pairing, tree, n.right);
    pairing.visit(n.left, n.right);
}

/// The same of different cells of one mesh, whose tree is of swept boxes.
template <typename VisitCells>
void for_each_own_cell_pair(const SweptMesh& swept, const VisitCells& visit_cells) {
    const BoxTree& tree = tree_of(swept);
    if (tree.empty()) return;
    const auto box = [&](int node) -> const Box& { return tree.nodes[node].box; };
    visit_own_pairs(
        TreePairing<decltype(box), decltype(box), VisitCells>{swept, swept, box, box, visit_cells}, tree, 0);
}

bool has_vertex(const Patch& patch, int vertex) {
    return std::find(patch.vertices.begin(), patch.vertices.end(), vertex) != patch.vertices.end();
}

/// Whether two features of one mesh have a vertex in common.
bool share_vertex(const CollisionMesh& mesh, const FeaturePair& pair) {
    switch (pair.type) {
        case ContactType::vertex_patch:
            return has_vertex(mesh.patches[pair.feature_b], pair.feature_a);
        case ContactType::patch_vertex:
            return has_vertex(mesh.patches[pair.feature_a], pair.feature_b);
        case ContactType::edge_edge:
            break;
    }
    const Edge &a = mesh.edges[pair.feature_a], &b = mesh.edges[pair.feature_b];
    return a.p0 == b.p0 || a.p0 == b.p1 || a.p1 == b.p0 || a.p1 == b.p1;
}

/// A patch where its mesh's motion begins.
struct PlacedPatch {
    const Patch* patch = nullptr;
    std::vector<Vec3> corners;
    Vec3 normal;

    void place(const SweptMesh& swept, int index) {
        patch = &swept.mesh->patches[index];
        corners.clear();
        for (int v : patch->vertices)
            corners.push_back(swept.begin != nullptr ? swept.begin[v] : swept.sweep.begin * swept.mesh->vertices[v]);
        normal = swept.begin != nullptr ? polygon_normal(corners.data(), static_cast<int>(corners.size()))
                                        : Vec3(swept.sweep.begin.R * patch->normal);
    }
};

/// Whether a side of patch p goes through patch q, convex and planar. Of one mesh, sides that end at q do not.
bool side_crosses(const PlacedPatch& p, const PlacedPatch& q, bool same_mesh) {
    const std::size_t p_count = p.corners.size(), q_count = q.corners.size();
    if (p_count < 2 || q_count < 3) return false;
    for (std::size_t k = 0; k < p_count; ++k) {
        const std::size_t next = (k + 1) % p_count;
        const Vec3 &from = p.corners[k], &to = p.corners[next];
        const double height0 = q.normal.dot(from - q.corners[0]), height1 = q.normal.dot(to - q.corners[0]);
        if (!(height0 * height1 < 0.0)) continue;
        if (same_mesh && (has_vertex(*q.patch, p.patch->vertices[k]) || has_vertex(*q.patch, p.patch->vertices[next])))
            continue;
        const Vec3 point = from + height0 / (height0 - height1) * (to - from);
        bool inside = true;
        for (std::size_t l = 0; l < q_count && inside; ++l)
            inside = q.normal.dot((q.corners[(l + 1) % q_count] - q.corners[l]).cross(point - q.corners[l])) >= 0.0;
        if (inside) return true;
    }
    return false;
}

/// Visits pairs of cells and notes whether the patches of one go through each other.
struct CrossingCheck {
    const SweptMesh &a, &b;
    bool same_mesh;
    mutable bool found = false;
    mutable PlacedPatch p = {}, q = {};  // of which the memory is reused

    void operator()(const Cell& cell_a, const Cell& cell_b) const {
        if (found) return;
        p.place(a, cell_a.patch);
        q.place(b, cell_b.patch);
        found = side_crosses(p, q, same_mesh) || side_crosses(q, p, same_mesh);
    }
};

/// The corners of a feature at both ends of its mesh's motion; of a patch also its normal where the motion begins.
struct PlacedFeature {
    std::vector<Vec3> begin, end;
    Vec3 normal = Vec3::Zero();

    void clear() {
        begin.clear();
        end.clear();
    }
    void add(const SweptMesh& swept, int vertex) {
        if (swept.begin != nullptr) {
            begin.push_back(swept.begin[vertex]);
            end.push_back(swept.end[vertex]);
        } else {
            begin.push_back(swept.sweep.begin * swept.mesh->vertices[vertex]);
            end.push_back(swept.sweep.end * swept.mesh->vertices[vertex]);
        }
    }
    void place_vertex(const SweptMesh& swept, int vertex) {
        clear();
        add(swept, vertex);
    }
    void place_edge(const SweptMesh& swept, int edge) {
        clear();
        add(swept, swept.mesh->edges[edge].p0);
        add(swept, swept.mesh->edges[edge].p1);
    }
    void place_patch(const SweptMesh& swept, int patch) {
        clear();
        for (int v : swept.mesh->patches[patch].vertices) add(swept, v);
        normal = polygon_normal(begin.data(), static_cast<int>(begin.size()));
    }
    PolygonView polygon() const { return {begin.data(), static_cast<int>(begin.size()), normal}; }
    double least_move(const Vec3& direction) const {
        double least = kInfinity;
        for (std::size_t k = 0; k < begin.size(); ++k) least = std::min(least, direction.dot(end[k] - begin[k]));
        return least;
    }
};

/// Whether two features stay further apart than both meshes reach. The plane through their closest points where the
/// motion begins, normal to their offset, is between them; they come no nearer than by what they move towards it. Two
/// meshes may be at different points of their ways: one may be stopped where the other goes on, so that what one gives
/// way to the other does not count. Features of one mesh are on theirs together.
class ApartTest {
public:
    ApartTest(const SweptMesh& a, const SweptMesh& b) : m_a(a), m_b(b) {}

    bool operator()(const FeaturePair& pair) {
        const ClosestPoints points = closest(pair);
        const Vec3 offset = points.a.point - points.b.point;
        const double distance = offset.norm();
        if (!(distance > m_a.reach + m_b.reach)) return false;
        const Vec3 normal = offset / distance;
        const double opening_a = m_feature_a.least_move(normal), opening_b = m_feature_b.least_move(-normal);
        const double opening = m_a.mesh == m_b.mesh ? std::min(opening_a + opening_b, 0.0)
                                                    : std::min(opening_a, 0.0) + std::min(opening_b, 0.0);
        return distance + opening > m_a.reach + m_b.reach;
    }

private:
    ClosestPoints closest(const FeaturePair& pair) {
        switch (pair.type) {
            case ContactType::vertex_patch:
                m_feature_a.place_vertex(m_a, pair.feature_a);
                m_feature_b.place_patch(m_b, pair.feature_b);
                return closest_vertex_polygon(m_feature_a.begin[0], m_feature_b.polygon());
            case ContactType::patch_vertex: {
                m_feature_a.place_patch(m_a, pair.feature_a);
                m_feature_b.place_vertex(m_b, pair.feature_b);
                ClosestPoints points = closest_vertex_polygon(m_feature_b.begin[0], m_feature_a.polygon());
                std::swap(points.a.point, points.b.point);
                return points;
            }
            case ContactType::edge_edge:
                break;
        }
        m_feature_a.place_edge(m_a, pair.feature_a);
        m_feature_b.place_edge(m_b, pair.feature_b);
        return closest_edge_edge(
            m_feature_a.begin[0], m_feature_a.begin[1], m_feature_b.begin[0], m_feature_b.begin[1]);
    }

    const SweptMesh &m_a, &m_b;
    PlacedFeature m_feature_a, m_feature_b;  // of which the memory is reused
};

}  // namespace

void drop_distant_pairs(const SweptMesh& a, const SweptMesh& b, std::vector<FeaturePair>& pairs) {
    ApartTest apart(a, b);
    pairs.erase(
        std::remove_if(pairs.begin(), pairs.end(), [&](const FeaturePair& p) { return apart(p); }), pairs.end());
}

BoxTree refitted_tree(const SweptMesh& swept) {
    BoxTree tree = swept.mesh->tree;
    const SweptBoxes boxes(swept);
    std::vector<Box> cells;
    cells.reserve(swept.mesh->cells.size());
    for (const auto& cell : swept.mesh->cells) cells.push_back(patch_box(boxes, cell.patch));
    refit(tree, cells);
    return tree;
}

Box swept_box(const SweptMesh& swept) { return node_box(swept, 0); }

void SweptBoxes::assign(const SweptMesh& swept) {
    m_swept = swept;
    const std::size_t vertex_count = swept.mesh->vertices.size(), node_count = swept.mesh->tree.nodes.size();
    if (m_vertices.size() < vertex_count) m_vertices.resize(vertex_count);
    if (m_nodes.size() < node_count) m_nodes.resize(node_count);
    m_vertex_made.assign(vertex_count, 0);
    m_node_made.assign(node_count, 0);
}

const Box& SweptBoxes::vertex(int v) const {
    const auto k = static_cast<std::size_t>(v);
    if (!m_vertex_made[k]) m_vertices[k] = vertex_box(m_swept, v);
    m_vertex_made[k] = 1;
    return m_vertices[k];
}

const Box& SweptBoxes::node(int n) const {
    const auto k = static_cast<std::size_t>(n);
    if (!m_node_made[k]) m_nodes[k] = node_box(m_swept, n);
    m_node_made[k] = 1;
    return m_nodes[k];
}

void collect_feature_pairs(const SweptBoxes& a, const SweptBoxes& b, std::vector<FeaturePair>& pairs) {
    for_each_cell_pair(a, b, [&](const Cell& cell_a, const Cell& cell_b) { pair_cells(a, cell_a, b, cell_b, pairs); });
}

void collect_self_pairs(const SweptMesh& swept, std::vector<FeaturePair>& pairs) {
    const SweptBoxes boxes(swept);
    for_each_own_cell_pair(swept, [&](const Cell& cell_a, const Cell& cell_b) {
        const auto first = static_cast<std::ptrdiff_t>(pairs.size());
        pair_cells(boxes, cell_a, boxes, cell_b, pairs);
        const auto share = [&](const FeaturePair& pair) { return share_vertex(*swept.mesh, pair); };
        pairs.erase(std::remove_if(pairs.begin() + first, pairs.end(), share), pairs.end());
    });
}

bool meshes_cross(const SweptMesh& a, const SweptMesh& b) {
    const CrossingCheck check{a, b, false};
    for_each_cell_pair(a, b, check);
    return check.found;
}

bool crosses_itself(const SweptMesh& swept) {
    const CrossingCheck check{swept, swept, true};
    for_each_own_cell_pair(swept, check);
    return check.found;
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
