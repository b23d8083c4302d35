"""Decides queries exactly in rational arithmetic: Python integers and NumPy, no Warp, no Bernstein signs.

What counts as a collision
--------------------------
Each point moves as x(t) = (1-t) x0 + t x1, its coordinates being exactly the floating-point numbers given. A
vertex-face pair collides when some t in the closed [0, 1] puts the point in the closed triangle; an edge-edge pair when
the closed segments meet at some t in the closed [0, 1]. Triangles and segments may degenerate. With a minimum distance
d, exactly the number given, a pair collides when some t in the closed [0, 1] puts its closed features within the closed
distance d of each other.

One question
------------
Every query is whether a moving triangle with corners x(t), y(t), z(t) contains the origin:

- vertex-face: p is in the triangle a b c when the origin is in the triangle a-p, b-p, c-p;
- edge-edge: the differences of points of ab and of cd fill the parallelogram a-c, b-c, b-d, a-d. Its diagonal cuts it
  into two triangles, and the segments meet when one of these contains the origin;
- an edge meets a face when a vertex that runs along the edge meets the face at rest.

The test at one time
--------------------
Let X = y x z, Y = z x x, Z = x x y (cross products), n = X + Y + Z (the normal) and volume = x.X.

- When the triangle contains the origin, volume = 0. Let it be so.
- When n != 0, the origin is in the triangle's plane, as x.n = y.n = z.n = volume. Its barycentric coordinates are n.X,
  n.Y and n.Z, each divided by n.n, which is their sum. It is in the triangle when none is negative.
- All three are zero exactly when n = 0. The triangle is then the union of its edges, and the origin is on the segment
  xy exactly when Z = 0 and x.y <= 0, for x = y and x = 0 too.

All are polynomials in t with integer coefficients, once a power of two has made the coordinates integers.

The times to look at
--------------------
The times of contact form a closed set, so there is a first one, t*. It is 0, or a root of

- volume, when that is not identically zero;
- else, when the origin always is in the plane, Z.Z of an edge xy, or x.y where Z is identically zero: were n(t*) != 0
  and all three barycentric coordinates positive, they would be so just before t* too, where there is no contact yet.
  So the origin is on an edge at t*: Z = 0 and x.y <= 0 there, and just before t* one of the two is not so.

A root of f is held between two times that are not roots, and the sign of q there comes from the theorem of Sturm and
Tarski: from the first time to the second, the number of changes of sign along the sequence of signed remainders that
starts with f and f' q falls by the number of distinct roots of f between them with q > 0, less those with q < 0. With
q = 1 it counts the roots.

A minimum distance
------------------
The differences of the points of two features fill a moving polygon: one point for two vertices, a segment for a vertex
and an edge, a triangle for a vertex and a face, a parallelogram for two edges. The query is whether its distance from
the origin is at most d at some time. With corners q and r of a side, e = r - q and the polygon's normal n, the polygon
is within d at one time exactly when

- a corner is: q.q <= d^2;
- or a side is, with the foot of the perpendicular between its ends: e != 0, q.e <= 0 <= r.e, and
  |q x r|^2 <= d^2 e.e;
- or the plane is, with the foot inside: n != 0, n.(q x r) >= 0 for all sides, and (q.n)^2 <= d^2 n.n.

Each is a polynomial of degree at most 6. At the first time t* > 0 of the closed set of these times the distance is d,
and the closest point is a corner, or inside a side with e != 0, or inside the polygon with n != 0, because a polygon
without a normal is the union of its sides, and a side without length is a corner. In each case the line's last
condition is an equation at t*. Its polynomial is not identically zero: the foot moves continuously, so that it would be
inside, at the distance d, just before t* as well. Thus t* is 0 or a root of the last polynomial of a line, and the
other conditions of that line hold there.
"""

from .at_rest import edge_face_crossings, edges_pass_faces, rays_pass_faces
from .queries import (
    edge_edge,
    edge_edge_toi,
    vertex_edge,
    vertex_edge_toi,
    vertex_face,
    vertex_face_toi,
    vertex_vertex,
    vertex_vertex_toi,
)
from .tetrahedra import tetrahedron, tetrahedron_toi

__all__ = [
    "edge_edge",
    "edge_edge_toi",
    "edge_face_crossings",
    "edges_pass_faces",
    "rays_pass_faces",
    "tetrahedron",
    "tetrahedron_toi",
    "vertex_edge",
    "vertex_edge_toi",
    "vertex_face",
    "vertex_face_toi",
    "vertex_vertex",
    "vertex_vertex_toi",
]
