"""Arrays of contact forces as structs: what no pair has, sums of impulses, and the rows of contacts."""

import warp as wp


@wp.struct
class Sides:
    """What the vertices and planes of a mesh belong to."""

    particle_count: int  # the vertices of shapes follow the particles
    shape: wp.array[int]  # of a vertex of a shape
    body: wp.array[int]  # of a vertex of a shape, -1 for none
    com: wp.array[wp.vec3]  # centre of mass in the frame of a body [m]; empty without bodies
    body_world: wp.array[int]
    plane_shape: wp.array[int]
    plane_body: wp.array[int]
    local_shape: wp.array[int]  # number of a shape among those of a world, see ContactReport.shapes_of_worlds
    max_local: int  # the number that stands for particles, one more than the largest of a shape


@wp.struct
class Unpaired:
    """Changes of momentum that no pair of contact points has."""

    of_particles: wp.array[wp.vec3d]  # [N s]
    of_bodies: wp.array2d[wp.vec3d]  # [N s], and about the centre of mass [N m s]
    idle_of_particles: wp.array2d[wp.int64]  # multipliers of contacts that changed no velocity, in units of the sums
    idle_of_bodies: wp.array2d[wp.int64]


@wp.struct
class ImpulseSums:
    """Sums of impulses in units of :mod:`.sums`, which are the same in any order of threads."""

    of_particles: wp.array2d[wp.int64]
    of_bodies: wp.array2d[wp.int64]
    of_shapes: wp.array2d[wp.int64]
    of_pairs: wp.array2d[wp.int64]  # of shapes, flat; empty if there are too many
    largest: wp.array[float]  # normal impulse of a contact in each world [N s]


@wp.struct
class ContactRows:
    """The contacts of a step; see :class:`.contact_report.Contacts`, which has the same arrays."""

    count: wp.array[int]  # of contacts, whether they fit or not
    lost: wp.array[int]  # what was too large for a sum
    kind: wp.array[int]
    vertices: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4]
    shapes: wp.array[wp.vec2i]
    bodies: wp.array[wp.vec2i]
    world: wp.array[int]
    toi: wp.array[float]
    point: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    velocity: wp.array[wp.vec3]
    normal_impulse: wp.array[float]
    tangential_impulse: wp.array[wp.vec3]


@wp.struct
class PublishedImpulses:
    """The sums as they are published; see :class:`.contact_report.ContactReport`."""

    particle: wp.array[wp.vec3]
    unpaired_particle: wp.array[wp.vec3]
    body: wp.array[wp.spatial_vector]
    unpaired_body: wp.array[wp.spatial_vector]
    shape: wp.array[wp.vec3]
    pair: wp.array[wp.vec3]
    max_impulse: wp.array[float]
