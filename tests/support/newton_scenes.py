"""Scenes of cloth for the collision stage, and rollouts whose every step exact detection looks at again."""

import newton
import numpy as np
import warp as wp

import warp_bsc as bsc
from warp_bsc import checker
from warp_bsc.detection.narrow.on_host import pair_distances
from warp_bsc.detection.run.settings import PairKind
from warp_bsc.response.state.mesh import ModelMesh

DT = 1.0 / 240.0
"""Length of a step [s]."""
STIFF = {"tri_ke": 1e3, "tri_ka": 1e3, "tri_kd": 1e-1, "edge_ke": 1e-2, "edge_kd": 1e-3, "particle_radius": 0.005}
SOFT = {"tri_ke": 2e2, "tri_ka": 2e2, "tri_kd": 1e-3, "edge_ke": 1e-3, "edge_kd": 1e-4, "particle_radius": 0.005}
_HALF_PLATE = 0.05
_SHRUNK = 1.0 - 2.0**-28
"""What is left at least of the distance of a pair that started nearer than it is to keep, up to rounding."""
_ROUNDING = 2.0**-38
"""Bound on the rounding of distances, as a share of the size of a pair."""


def semi_implicit(model):
    """The explicit solver, without its own contacts between particles, which are far too stiff here."""
    model.particle_ke = model.particle_kd = model.particle_kf = 0.0
    return newton.solvers.SolverSemiImplicit(model)


SOLVERS = {
    "vbd": lambda model: newton.solvers.SolverVBD(model, iterations=5, rigid_compliant_alm=True),
    "xpbd": lambda model: newton.solvers.SolverXPBD(model, iterations=5),
    "semi_implicit": semi_implicit,
}


class Changed(newton.solvers.SolverXPBD):
    """Lets particles fly on without forces, and then changes the state at the end as a function says."""

    def __init__(self, model, change=None):
        super().__init__(model, iterations=0)
        self.change = change

    def step(self, state_in, state_out, *arguments, **options):
        bodies = None if state_in.body_q is None else wp.clone(state_in.body_q)
        super().step(state_in, state_out, *arguments, **options)
        if bodies is not None:
            wp.copy(state_out.body_q, bodies)
        if self.change is not None:
            self.change(state_out)


class Still(newton.solvers.SolverBase):
    """Leaves the state at the end as it is given, or as a function makes it that gets both states."""

    def __init__(self, model, move=None):
        super().__init__(model)
        self._move = move

    def step(self, state_in, state_out, control, contacts, dt):
        if self._move is not None:
            self._move(state_in, state_out)


def grid(cells, cell, axes="xy"):
    """Arguments of a grid with as many cells of one size [m] along each axis."""
    return {f"dim_{axis}": cells for axis in axes} | {f"cell_{axis}": cell for axis in axes}


def add_square(builder, n, cell, at, axis=(1.0, 0.0, 0.0), angle=0.0, velocity=(0.0, 0.0, 0.0), **options):
    """A square patch of cloth, centred, turned about an axis."""
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), angle)
    corner = wp.vec3(*at) + wp.quat_rotate(rotation, wp.vec3(-0.5 * n * cell, -0.5 * n * cell, 0.0))
    place = {"pos": corner, "rot": rotation, "vel": wp.vec3(*velocity)}
    builder.add_cloth_grid(**place, **grid(n, cell), mass=0.001, **options)


def add_patch(builder, n, cell, at, *, velocity=(0, 0, 0), fixed=False, **options):
    """A square patch of cloth, centred, in the xy plane."""
    corner = np.subtract(at, (0.5 * n * cell, 0.5 * n * cell, 0.0))
    sides = dict.fromkeys(["fix_left", "fix_right", "fix_top", "fix_bottom"], fixed)
    place = {"pos": wp.vec3(*corner), "rot": wp.quat_identity(), "vel": wp.vec3(*velocity)}
    builder.add_cloth_grid(**place, **grid(n, cell), mass=0.001, **sides, **STIFF, **options)


def bullet(speed, *, device, worlds=1):
    """A patch shot at a sheet that is held at its border."""
    world = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_patch(world, 16, 0.05, (0.0, 0.0, 0.0), fixed=True)
    add_patch(world, 8, 0.03, (0.011, 0.017, 0.1), velocity=(0.0, 0.0, -speed))
    builder = world
    if worlds > 1:
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.replicate(world, worlds)
    builder.color()
    return builder.finalize(device=device)


def add_rope(builder, points, *, mass=0.002, velocity=(0, 0, 0), stiffness=1e3, damping=0.01, radius=0.004):
    """Particles at some positions, and springs from each to the next."""
    first = builder.particle_count
    for point in np.asarray(points, dtype=float).tolist():
        builder.add_particle(wp.vec3(*point), wp.vec3(*velocity), mass, radius=radius)
    for i in range(first, builder.particle_count - 1):
        builder.add_spring(i, i + 1, stiffness, damping, 0.0)


def strands(device, worlds=1):
    """Two ropes and loose particles that fall onto each other, and onto a patch that is held at its border."""
    world = newton.ModelBuilder()
    add_patch(world, 5, 0.04, (0.0, 0.0, 0.0), fixed=True)
    along = np.linspace(-0.09, 0.09, 10)
    add_rope(world, np.stack([along, 0.01 + 0.1 * along, 0.02 + 0.0 * along], axis=1), velocity=(0.0, 0.0, -1.5))
    add_rope(world, np.stack([0.1 * along, along, 0.04 + 0.0 * along], axis=1), velocity=(0.0, 0.0, -3.0))
    for i, height in enumerate((0.055, 0.07, 0.085)):
        at = wp.vec3(0.001 * i, 0.012 - 0.001 * i, height)
        world.add_particle(at, wp.vec3(0.0, 0.0, -4.0 - i), 0.002, radius=0.004)
    builder = world
    if worlds > 1:
        builder = newton.ModelBuilder()
        builder.replicate(world, worlds)
    builder.color()
    return builder.finalize(device=device)


def add_crossing_sheets(builder, pull, n=8, cell=0.05):
    """Two sheets that cross each other, the lower one with velocity ``-pull``, the upper one with ``pull``."""
    side = n * cell
    tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(0.3, 1.0, 0.1)), 0.3)
    options = {**grid(n, cell), "mass": 0.001, **SOFT}
    at, tilted_at = wp.vec3(-0.5 * side, -0.5 * side, 0.0), wp.vec3(-0.5 * side, 0.01 - 0.5 * side, 0.16 * side)
    builder.add_cloth_grid(pos=at, rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, -pull), **options)
    builder.add_cloth_grid(pos=tilted_at, rot=tilt, vel=wp.vec3(0.0, 0.0, pull), **options)


def crossing_sheets(pull, *, device):
    """A model of nothing but two sheets that cross each other."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    add_crossing_sheets(builder, pull)
    builder.color()
    return builder.finalize(device=device)


def add_plates(builder, gap):
    """Two kinematic plates, ``gap`` apart, with a bent patch of cloth between them."""
    first = builder.particle_count
    add_patch(builder, 6, 0.04, (0.0, 0.0, 0.0))
    for particle in range(first, builder.particle_count):
        x, y, _ = builder.particle_q[particle]
        builder.particle_q[particle] = wp.vec3(x, y, 0.01 * float(np.sin(20.0 * x) * np.cos(17.0 * y)))
    for height in plate_heights(gap):
        body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, height), wp.quat_identity()), is_kinematic=True)
        builder.add_shape_box(body, hx=0.2, hy=0.2, hz=_HALF_PLATE)


def place_plates(state, gap):
    """Sets the heights of the first two bodies so that plates are ``gap`` apart."""
    body_q = state.body_q.numpy()
    body_q[:2, 2] = plate_heights(gap)
    state.body_q.assign(body_q)


def plate_heights(gap):
    """Heights of two plates that are this far apart."""
    return -_HALF_PLATE - 0.5 * gap, _HALF_PLATE + 0.5 * gap


class Rollout:
    """Steps a solver, and asks exact detection about the motion of each step as it is stored.

    Attributes:
        collisions: Collisions so far, except for those of two shapes, and of pairs that touched or crossed at the start
            of their step.
        new_collisions: The four vertices of each of them in the last step.
        start: Positions of all vertices at the start of the last step.
    """

    def __init__(self, model, solver):
        self.model, self.solver = model, solver
        self.states = model.state(), model.state()
        self.control = model.control()
        self.mesh = ModelMesh(model)
        self.detector = bsc.CollisionDetector(self.mesh, method="exact")
        self.collisions = 0
        self.new_collisions = []
        self.start = self.vertices(self.states[0])

    def step(self, dt=DT, contacts=None):
        start, end = self.states
        self.start = self.vertices(start)  # the inner solver may overwrite it
        start.clear_forces()
        self.solver.step(start, end, self.control, contacts, dt)
        self.states = end, start
        self.new_collisions = self.find_collisions(self.start, self.vertices(end))
        self.collisions += len(self.new_collisions)

    def find_collisions(self, before, after):
        """The vertices of each collision of a motion, without those of shapes, and of what touched or crossed before.

        Exact detection of the start at rest says which pairs touched.
        """
        movable = self.mesh.inverse_masses.numpy() > 0.0
        edges, faces = self.mesh.edges, self.mesh.faces
        c = self.detector.detect(before, after)
        own = movable[c.vertex_face[:, 0]] | movable[faces[c.vertex_face[:, 1]]].any(axis=1)
        vertex_face = set(map(tuple, c.vertex_face[own].tolist()))
        own = movable[edges[c.edge_edge]].any(axis=(1, 2))
        edge_edge = set(map(tuple, c.edge_edge[own].tolist()))
        if not vertex_face and not edge_edge:
            return []
        touching = self.detector.detect(before, before)
        vertex_face -= set(map(tuple, touching.vertex_face.tolist()))
        edge_edge -= set(map(tuple, touching.edge_edge.tolist()))
        crossing = self.find_crossings(before, inside=True)
        found = [[v, *faces[f].tolist()] for v, f in vertex_face if not self.vertex_crosses(v, f, crossing)]
        return found + [edges[[a, b]].ravel().tolist() for a, b in edge_edge if not self.edges_cross(a, b, crossing)]

    def find_crossings(self, x, inside=False):
        """The edges and faces that meet in one configuration and can be moved; if asked, only those that do inside."""
        movable = self.mesh.inverse_masses.numpy() > 0.0
        pairs = self.detector.find_intersections(x)
        own = movable[self.mesh.edges[pairs[:, 0]]].any(axis=1) | movable[self.mesh.faces[pairs[:, 1]]].any(axis=1)
        pairs = pairs[own]
        if inside:  # as of faces without neighbours
            edges, faces = self.mesh.edges[pairs[:, 0]], self.mesh.faces[pairs[:, 1]]
            pairs = pairs[checker.edges_pass_faces(x[edges], x[faces], x[faces[:, [2, 0, 1]]])]
        return set(map(tuple, pairs.tolist()))

    def vertex_crosses(self, vertex, face, crossings):
        """Whether an edge of a vertex is among those that cross a face."""
        return any((edge, face) in crossings for edge in np.flatnonzero((self.mesh.edges == vertex).any(axis=1)))

    def edges_cross(self, edge, other, crossings):
        """Whether one of two edges is among those that cross a face of the other."""
        for a, b in ((edge, other), (other, edge)):
            faces = np.flatnonzero(np.isin(self.mesh.faces, self.mesh.edges[b]).sum(axis=1) == 2)
            if any((a, face) in crossings for face in faces):
                return True
        return False

    def vertices(self, state):
        """The positions of all vertices in a state, those of shapes too."""
        x = wp.empty(self.mesh.vertex_count, dtype=wp.vec3, device=self.mesh.device)
        self.mesh.positions(state.particle_q, state.body_q if self.model.body_count else None, x)
        return x.numpy()

    @property
    def positions(self):
        return self.states[0].particle_q.numpy().copy()

    @property
    def velocities(self):
        return self.states[0].particle_qd.numpy().copy()

    def momenta(self):
        mass = self.model.particle_mass.numpy()[:, None].astype(float)
        p = mass * self.velocities
        return p.sum(axis=0), np.cross(self.positions.astype(float), p).sum(axis=0)


class DistanceRollout(Rollout):
    """Steps a stage, and counts the pairs that came nearer than they may.

    Attributes:
        approaches: Number of these so far.
        near: Pairs so far that came within their minimum distance, all of which started there.
    """

    def __init__(self, model, solver, distance=0.0, radius=0.0):
        super().__init__(model, solver)
        self.mesh = solver.mesh
        radii = np.zeros(self.mesh.vertex_count)
        radii[: model.particle_count] = radius
        self.radius = radii + 0.5 * distance
        mesh = bsc.CollisionMesh(
            self.mesh.faces,
            self.mesh.vertex_count,
            edges=self.mesh.edges[self.mesh.free_edges],
            points=self.mesh.points,
            radius=self.radius,
            world=self.mesh.world,
            device=model.device,
        )
        self.distances = bsc.CollisionDetector(mesh, method="exact")
        self.approaches = self.near = 0

    def step(self, dt=DT, contacts=None):
        super().step(dt, contacts)
        movable = self.mesh.inverse_masses.numpy() > 0.0
        before, after = self.start, self.vertices(self.states[0])
        found = self.distances.detect(before, after)
        at_rest = self.distances.find_proximities(before, 2.0 * self.radius.max())
        pairs_at_rest = [getattr(at_rest, kind.label) for kind in PairKind]
        starts = np.split(at_rest.distance, np.cumsum([len(pairs) for pairs in pairs_at_rest])[:-1])
        for kind, near, starts_of_kind in zip(PairKind, pairs_at_rest, starts, strict=True):
            pairs = getattr(found, kind.label)
            elements = self.mesh.faces if kind == PairKind.VERTEX_FACE else self.mesh.edges
            corners, distance = pair_distances(kind, elements, pairs, self.radius)
            known = dict(zip(map(tuple, near.tolist()), starts_of_kind, strict=True))
            start = np.array([known.get(tuple(pair), np.inf) for pair in pairs.tolist()])
            own = movable[corners].any(axis=1) & (start > 0.0)  # the others touch, or are counted among the collisions
            self.near += np.count_nonzero(own)
            start, distance, corners = start[own], distance[own], corners[own]
            self.approaches += np.count_nonzero(start > distance)  # farther at the start, but not in the step
            points = np.concatenate([before[corners], after[corners]], axis=1)
            query = getattr(bsc, f"query_{kind.label}")
            rounding = _ROUNDING * np.ptp(points[:, :4], axis=1).max(axis=1, initial=0.0)
            kept = np.where(start < distance, _SHRUNK * start - rounding, distance)
            if (kept > 0.0).any():
                self.approaches += np.count_nonzero(query(points[kept > 0.0], min_distance=kept[kept > 0.0]).hit)
