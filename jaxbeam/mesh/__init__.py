"""Bodies at rest: elements, meshes of triangles, lines of rods, refinement, surfaces."""
