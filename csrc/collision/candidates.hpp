#pragma once

#include <cstdint>
#include <vector>

#include "geometry/collision_mesh.hpp"

namespace diffsim {

/// The two ends of a motion of one frame. Boxes around both ends of a vertex contain the straight path
/// between them.
struct Sweep {
    Pose begin, end;
};

/// A mesh in motion, rigid or deforming, and how far around itself it looks for others.
struct SweptMesh {
    const CollisionMesh* mesh;
    Sweep sweep;   ///< of a rigid mesh
    double reach;  ///< half-width added to all boxes [m]
    // Of a deforming mesh: its vertices at both ends of their straight paths, and its tree fitted to them.
    const Vec3* begin = nullptr;
    const Vec3* end = nullptr;
    const BoxTree* tree = nullptr;
};

/// A mesh in motion with boxes around its vertices and the nodes of its tree. Each is made when first asked for, and
/// serves all pairs with the mesh.
class SweptBoxes {
public:
    SweptBoxes() = default;
    SweptBoxes(const SweptMesh& swept) { assign(swept); }

    /// Start anew with another mesh or motion, in the same memory.
    void assign(const SweptMesh& swept);
    const SweptMesh& swept() const { return m_swept; }
    const Box& vertex(int v) const;
    const Box& node(int n) const;

private:
    SweptMesh m_swept{};
    mutable std::vector<Box> m_vertices, m_nodes;
    mutable std::vector<char> m_vertex_made, m_node_made;
};

enum class ContactType : std::uint8_t { vertex_patch, patch_vertex, edge_edge };

/// A pair of features that may come near each other: vertex of a and patch of b, patch of a and vertex of b,
/// or an edge of each.
struct FeaturePair {
    ContactType type;
    int feature_a, feature_b;
};

/// The tree of a deforming mesh, fitted to its swept vertices and reach.
BoxTree refitted_tree(const SweptMesh& swept);

/// World box around a mesh's swept vertices, inflated by its reach.
Box swept_box(const SweptMesh& swept);

/// Append every feature pair whose swept boxes overlap, in an order that depends on the meshes alone.
void collect_feature_pairs(const SweptBoxes& a, const SweptBoxes& b, std::vector<FeaturePair>& pairs);

/// The same within one deforming mesh; features that share a vertex do not count.
void collect_self_pairs(const SweptMesh& swept, std::vector<FeaturePair>& pairs);

/// Remove the pairs that stay further apart than the sum of both reaches although their boxes overlap: in a mesh of
/// triangles that is most neighbours. Each mesh may be anywhere on its way, wherever the other is. Costs a distance per
/// pair. Of one mesh with itself, whose features move at the same time: give it twice.
void drop_distant_pairs(const SweptMesh& a, const SweptMesh& b, std::vector<FeaturePair>& pairs);

/// Whether the surfaces of two meshes go through each other where their motions begin: a side of a patch of one through
/// a patch of the other. One mesh wholly inside another does not count, nor do points, nor two segments.
bool meshes_cross(const SweptMesh& a, const SweptMesh& b);

/// The same within one deforming mesh; sides and patches that share a vertex do not count.
bool crosses_itself(const SweptMesh& swept);

/// Append the vertices that come within `reach` (the mesh's own) of the half-space z <= height, at either end.
void collect_vertices_below(const SweptMesh& swept, double height, std::vector<int>& vertices);

}  // namespace diffsim
