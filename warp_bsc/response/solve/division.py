"""Division and truncation of paths that projection did not free of contacts; what still collides then is frozen.

A vertex is moved onto its sides of dividing planes, and a body back along its path until its vertices are. Where a
contact has no plane, the path is cut before the first contact. Frozen vertices end at their
start. Paths of vertices are also cut before a tetrahedron of theirs inverts, where that is prevented.
"""

import warp as wp

from ..._profiling import phase
from ..contacts import first_contact
from ..contacts.constraints import NEVER_VIOLATED, TOUCH, has_pushed, kind_of_pair, min_distance_of, moves_body
from ..contacts.first_contact import TIME_UNITS
from ..contacts.planes_between import add_dividing_plane, has_planes
from ..schedule import divides_now, divides_proximities, is_freezing, note_moved
from ..state.cluster import BLOCK
from ..state.poses import pose_between, velocity_between
from ..state.status import Loop, SolveStatus
from ..state.structs import (
    CUT_SHORT,
    DIVIDED,
    FROZEN,
    NEVER,
    NOT_PLACED,
    PROJECTED,
    TRUNCATED,
    UNCONSTRAINED,
    ContactKind,
    DividingPlanes,
    Step,
    Tetrahedra,
    constraint_count,
)
from ..state.vectors import ONE, to_double, to_single
from ..state.workspace import Workspace
from ..tuning import CUT, SHARE_OF_PATH
from .bodies import FREEZES, WHOLE_PATH, place_vertices
from .plane_placement import begin_passes, move_to_sides, pass_over_few_planes, place_planes, want
from .vertex_projection import share_of_path

wp.set_module_options({"enable_backward": False})


@wp.func
def _divide_proximity(step: Step, dividing: DividingPlanes, status: SolveStatus, i: int):
    constraints, outcome = step.constraints, step.vertices.outcome
    kind = constraints.kind[i]
    if kind != ContactKind.VERTEX_FACE_PROXIMITY and kind != ContactKind.EDGE_EDGE_PROXIMITY:
        return
    corners = constraints.vertices[i]
    if not divides_proximities(status, step.motion.world[corners[0]]) or moves_body(step, i):
        return
    if constraints.separation[i] == NEVER_VIOLATED:
        return
    divided = add_dividing_plane(step, corners, kind_of_pair(kind), min_distance_of(step, i), dividing, False)
    if divided and kind == ContactKind.VERTEX_FACE_PROXIMITY and not has_pushed(step, i):
        constraints.position_multiplier[i] = TOUCH * constraints.normal[i]
        for j in range(4):
            if step.motion.inverse_mass[corners[j]] > 0.0:
                outcome[corners[j]] = outcome[corners[j]] | PROJECTED


@wp.kernel
def divide_proximities(step: Step, dividing: DividingPlanes, status: SolveStatus, threads: int):
    """Adds dividing planes for proximities, of which those of vertices and faces then may change velocities.

    In a stack, a vertex that is moved onto one side comes into the next sheet, which would need an iteration for each.
    """
    for i in range(wp.tid(), constraint_count(step), threads):
        _divide_proximity(step, dividing, status, i)


@wp.kernel
def find_body_shares(step: Step, dividing: DividingPlanes, status: SolveStatus):
    """Finds the share of the path of each body up to which its vertices are above their dividing planes.

    The vertices go straight here, but in an arc where the body turns: if one ends below its plane for that and
    collides, the next iteration cuts the path again. Where a contact has no plane, the path ends before that contact.
    """
    motion, vertices = step.motion, step.vertices
    vertex = motion.bodies.particle_count + wp.tid()
    packed = vertices.first_contact[vertex]
    body = motion.bodies.of_vertex[vertex]
    if packed == NEVER or body < 0:
        return
    vertices.first_contact[vertex] = NEVER
    if motion.bodies.inverse_mass[body] == 0.0:
        return
    if is_freezing(status, motion.world[vertex]):
        wp.atomic_min(vertices.bodies.share, body, FREEZES)
        return
    share = ONE
    divides, complete = has_planes(dividing, vertex)
    if divides:
        share = share_of_path(dividing, vertex, to_double(motion.x0[vertex]), to_double(vertices.x1[vertex]))
    if not complete:
        share = wp.min(share, SHARE_OF_PATH * first_contact.contact_time(packed))
    if not complete or first_contact.contact_kind(packed) == ContactKind.NONE:
        vertices.bodies.loose[body] = 1
    if share < ONE:
        note_moved(status, motion.world[vertex])
    wp.atomic_min(vertices.bodies.share, body, wp.int64(wp.floor(TIME_UNITS * share)))


@wp.func
def _freeze_body(step: Step, body: int):
    """Puts a body back in its pose at the start, without velocity."""
    moved = step.vertices.bodies
    moved.pose[body] = step.motion.bodies.start[body]
    moved.velocity[body] = wp.spatial_vector()
    moved.outcome[body] = moved.outcome[body] | FROZEN


@wp.kernel
def cut_bodies(step: Step, status: SolveStatus, dt: wp.float64):
    """Moves each body whose path is cut back along it, or freezes it in its pose at the start."""
    body = wp.tid()
    bodies, moved = step.motion.bodies, step.vertices.bodies
    share = moved.share[body]
    moved.share[body] = WHOLE_PATH
    frozen = moved.outcome[body] & FROZEN != 0
    moved.moved[body] = wp.where(share < WHOLE_PATH and not frozen, 1, 0)
    if moved.moved[body] == 0:
        return
    if share == FREEZES:
        _freeze_body(step, body)
        wp.atomic_add(status.loop, int(Loop.NEWLY_FROZEN), 1)
        return
    start = bodies.start[body]
    end = pose_between(bodies, body, start, moved.pose[body], wp.float64(share) / TIME_UNITS)
    moved.pose[body] = end
    outcome = moved.outcome[body] | TRUNCATED
    if moved.loose[body] == 0:
        moved.outcome[body] = outcome | DIVIDED
        return
    moved.velocity[body] = velocity_between(bodies, body, start, end, dt)
    moved.outcome[body] = (outcome | DIVIDED) - DIVIDED


@wp.func
def _divided(dividing: DividingPlanes, vertex: int, outcome: int) -> int:
    """Returns the outcome of a vertex that ends where it has reached."""
    return outcome | wp.where(dividing.placed[vertex] == CUT_SHORT, DIVIDED | TRUNCATED, DIVIDED)


@wp.func
def _keep_on_sides(step: Step, dividing: DividingPlanes, status: SolveStatus, vertex: int):
    """Moves a vertex without a contact onto its sides, so that it comes into no element while others are divided."""
    vertices = step.vertices
    if dividing.first[vertex] < 0 or dividing.placed[vertex] == NOT_PLACED:
        return
    if step.motion.inverse_mass[vertex] == 0.0 or not divides_now(status, step.motion.world[vertex]):
        return
    x1 = vertices.x1[vertex]
    end = dividing.reached[vertex]
    if end[0] != x1[0] or end[1] != x1[1] or end[2] != x1[2]:
        note_moved(status, step.motion.world[vertex])
        vertices.x1[vertex] = end
        vertices.changed[vertex] = 1
        vertices.outcome[vertex] = _divided(dividing, vertex, vertices.outcome[vertex])


@wp.func
def _freeze_vertex(step: Step, dividing: DividingPlanes, vertex: int):
    """Puts a vertex back to its start, without velocity."""
    vertices = step.vertices
    vertices.x1[vertex] = step.motion.x0[vertex]
    vertices.velocity[vertex] = wp.vec3()
    vertices.outcome[vertex] = vertices.outcome[vertex] | FROZEN
    want(dividing, vertex, step.motion.x0[vertex])


@wp.kernel
def truncate_vertices(step: Step, dividing: DividingPlanes, status: SolveStatus, dt: wp.float64):
    """Moves each vertex that has planes onto its sides, or truncates its path before its first contact.

    Paths are truncated where contacts have no dividing planes. After ``max_divisions`` iterations vertices that still
    collide are frozen.
    """
    vertex = wp.tid()
    motion, vertices = step.motion, step.vertices
    packed = vertices.first_contact[vertex]
    if packed == NEVER:
        _keep_on_sides(step, dividing, status, vertex)
        return
    vertices.first_contact[vertex] = NEVER
    if motion.inverse_mass[vertex] == 0.0:
        return
    cuts = not is_freezing(status, motion.world[vertex])
    outcome = vertices.outcome[vertex]
    if not cuts and outcome & FROZEN != 0:
        return
    vertices.changed[vertex] = 1
    if not cuts:
        _freeze_vertex(step, dividing, vertex)
        wp.atomic_add(status.loop, int(Loop.NEWLY_FROZEN), 1)
        return
    x0 = motion.x0[vertex]
    end = vertices.x1[vertex]
    divides, complete = has_planes(dividing, vertex)
    if divides:
        end = dividing.reached[vertex]
        outcome = _divided(dividing, vertex, outcome)
    if not complete:
        path = first_contact.truncated_path(to_double(x0), to_double(end), first_contact.contact_time(packed))
        end = to_single(to_double(x0) + path)
        outcome = outcome | TRUNCATED
        want(dividing, vertex, end)
        if not divides:
            vertices.velocity[vertex] = to_single(path / dt)
    if divides and first_contact.contact_kind(packed) == ContactKind.NONE:
        vertices.velocity[vertex] = (end - x0) / float(dt)
        outcome = outcome | UNCONSTRAINED
    if wp.length_sq(end - vertices.x1[vertex]) > 0.0:
        note_moved(status, motion.world[vertex])
    vertices.x1[vertex] = end
    vertices.outcome[vertex] = outcome


@wp.kernel
def truncate_before_inversions(step: Step, tetrahedra: Tetrahedra, dividing: DividingPlanes, status: SolveStatus):
    """Truncates the path of each particle before the first inversion of a tetrahedron of its, or freezes it.

    In one sweep no path becomes shorter than by CUT: others are cut as well, and may then leave enough space.
    """
    particle = wp.tid()
    motion, vertices = step.motion, step.vertices
    packed = tetrahedra.first_inversion[particle]
    if packed == NEVER:
        return
    outcome = vertices.outcome[particle]
    if motion.inverse_mass[particle] == 0.0 or outcome & FROZEN != 0:
        return
    vertices.changed[particle] = 1
    if is_freezing(status, motion.world[particle]):
        _freeze_vertex(step, dividing, particle)
        wp.atomic_add(status.loop, int(Loop.NEWLY_FROZEN), 1)
        return
    x0 = to_double(motion.x0[particle])
    share = wp.max(SHARE_OF_PATH * first_contact.contact_time(packed), CUT)
    note_moved(status, motion.world[particle])
    vertices.x1[particle] = to_single(x0 + share * (to_double(vertices.x1[particle]) - x0))
    want(dividing, particle, vertices.x1[particle])
    vertices.outcome[particle] = outcome | TRUNCATED


@wp.kernel
def take_velocities_of_paths(step: Step, ends: wp.array[wp.vec3], dt: wp.float64):
    """Gives each particle that was moved from an end, but not frozen, the velocity of its path."""
    particle = wp.tid()
    vertices = step.vertices
    end = vertices.x1[particle]
    before = ends[particle]
    moved = end[0] != before[0] or end[1] != before[1] or end[2] != before[2]
    if moved and vertices.outcome[particle] & FROZEN == 0:
        vertices.velocity[particle] = (end - step.motion.x0[particle]) / float(dt)
        vertices.outcome[particle] = vertices.outcome[particle] | UNCONSTRAINED


@phase("divide")
def divide(work: Workspace, dt: float) -> None:
    """Moves vertices of worlds past their projections onto their sides; else cuts their paths, else freezes them."""
    particles, worlds, changed = work.particle_count, work.worlds, [work.dividing, work.status]
    work.launch_over_constraints(divide_proximities, *changed)
    work.launch(begin_passes, max(particles, worlds), [work.step, work.dividing, particles, worlds, work.status])
    threads = 1 if work.device.is_cpu else BLOCK
    inputs = [work.step, work.dividing, work.tolerance, work.status, threads]
    wp.launch(pass_over_few_planes, threads, inputs=inputs, device=work.device, block_dim=BLOCK)
    wp.capture_while(work.loop[Loop.MORE_PASSES], _pass_over_planes, work=work)
    work.launch_over_particles(truncate_vertices, *changed, dt)
    work.launch_over_shape_vertices(find_body_shares, *changed)
    work.launch_over_bodies(cut_bodies, work.status, dt)
    work.launch_over_shape_vertices(place_vertices)


def _pass_over_planes(work):
    work.launch_over_entries(place_planes, [work.step, work.dividing, work.status])
    work.launch_over_particles(move_to_sides, work.dividing, work.tolerance, work.status)
