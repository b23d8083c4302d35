"""All numbers that were tuned, and the limits on iterations and sweeps that :mod:`.schedule` explains."""

import warp as wp

# separations
SEPARATION = 5e-3
"""Default distance that contacts are moved apart, as a share of the median edge length."""
TOLERANCE = 0.1
"""Tolerance of constraints on positions, as a share of the separation."""
SLOW_PATH = wp.constant(wp.float64(0.5))
"""Longest path of slow elements, as a share of their shortest side."""
RESTING_PATH = wp.constant(wp.float64(4.0))
"""Longest path of proximities at rest, in separations: they are projected, so that friction holds them in place, others
are divided alone."""
RECOVERY = wp.constant(wp.float64(0.25))
"""Most that the distance of slow elements grows in a step, as a share of their longest path: elements that are pushed
apart further than they fall in a step hop, and slide meanwhile."""
REST = wp.constant(wp.float64(0.25))
"""Distance of what may rest from slow elements, as a share of their longest path, from which it does not grow: what is
further apart than it comes in a step does not collide in the next, and falls freely every few steps."""
ROUNDING = wp.constant(wp.float64(2.0**-20))
"""Least distance of what rests, as a share of its coordinates: 16 times their rounding, which closes smaller ones."""
SMALL_DISTANCE = wp.constant(wp.float64(0.1))
"""Least distance of other slow elements as a share of the separation, however short their paths are: a distance that is
nearly 0 is closed again by the rounding of positions."""
MAX_SAGITTA = wp.constant(wp.float64(4.0))
"""Most that the turn of a body adds to the separation of a contact, in separations."""
EARLIEST = wp.constant(wp.float64(2.0**-6))
"""Time, as a share of the step, from which a contact on an arc adds what the arc is ahead of its chord in full."""

# proximities and occluded edges
REACH = wp.constant(wp.float64(1.5))
"""Distance in separations up to which pairs are proximities even if they stand still: neighbours in a stack."""
BEHIND = wp.constant(wp.float64(1.5))
"""Distance, as a multiple of that of the nearest face in its direction, from which an element is behind that face."""
PARALLEL = wp.constant(wp.float64(0.03))
"""Squared sine of an angle below which edges are parallel: vertices and other edges hold first what they would."""
BEND_OF_SHEET, BEND_OF_BODY = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1e-3))
"""Sines of the angles by which a sheet may bend towards a body, and a body towards a sheet, which rounding allows."""

# sweeps
COUNTED = wp.constant(wp.float64(2.0 / 3.0))
"""Share of the active constraints of a vertex that counts where they only push: mostly they push the same way."""
PUSHING_MOMENTUM = wp.constant(wp.float64(0.5))
"""Largest momentum of a multiplier that only pushes."""
SLIDING = wp.constant(wp.float64(0.999))
"""Share of the friction limit from which a contact slides."""
CREEP = wp.constant(wp.float64(0.1))
"""Longest path of a contact that friction holds, as a share of the tolerance; it adds up over steps."""
TOLERANCE_OF_BODIES = wp.constant(wp.float64(0.1))
"""Tolerance of a constraint on a body as a share of that of others: a body moves as one, so that its motion shows."""
TOLERANCE_OF_DISTANCE = wp.constant(wp.float64(0.5))
"""Largest tolerance of a position constraint as a share of its separation: elements that it holds stay apart."""
TOLERANCE_OF_CHANGE = wp.constant(wp.float64(0.1))
"""Largest tolerance of a contact with a plane as a share of its change by projection: what rests moves very little."""
CLOSE_EDGES = wp.constant(wp.float64(0.1))
"""Distance of edges in a proximity at the start, as a share of their separation, below which they are projected in any
case: dividing planes keep a share of the distance, which becomes ever smaller where something presses."""
MAX_TURN = wp.constant(wp.float64(0.1))
"""Largest turn that restores angular momentum, as a share of the velocity changes by contacts, root mean square."""

# division and truncation
SHARE_OF_PATH = wp.constant(wp.float64(0.9))
"""Share of the way to its first contact that a truncated vertex goes, and a body whose vertices have no planes."""
CUT = wp.constant(wp.float64(0.5))
"""Least share of its path that a vertex keeps in a sweep that prevents inversions."""
MARGIN = wp.constant(wp.float64(0.2))
"""Least distance from a dividing plane after projection, as a share of the elements' distance at the start."""
CLOSE_MARGIN = wp.constant(wp.float64(0.45))
"""The same of elements so close that they may hardly come nearer, step after step: positions are rounded."""
CLOSE_TOGETHER = wp.constant(wp.float64(2.0))
"""Their distance in separations at most. With less, a pile becomes so dense that many sheets are near each other."""
FAR_APART = wp.constant(wp.float64(4.0))
"""Distance at the start, in separations, from which on margins are the same: elements that fall on each other come near
in the first step, and contacts change only velocities of pairs that are."""
SLACK = wp.constant(wp.float64(0.05))
"""How much farther than that both are from the plane at the start at least, as a share of their distance."""
WEDGE = wp.constant(wp.float64(4.0))
"""Most that a vertex may be moved, beyond its path, in multiples of how far the start is below a plane."""
MAX_PLANE_STEPS = wp.constant(64)
"""Steps of the projection of a vertex onto its planes: it takes 4 on average, and 21 at most were seen."""

# infinite planes
PLANE_MARGIN = wp.constant(wp.float64(0.1))
"""Distance from a plane, as a share of the separation, that a vertex gets if projection has not kept it out."""
PLANE_APPROACH = wp.constant(wp.float64(0.25))
"""Most of that, beyond rounding, as a share of how far the vertex would be if it stood still: see
:mod:`.contacts.planes_between`."""
PLANE_DEPTH = wp.constant(wp.float64(0.05))
"""Most that a vertex of a body goes deeper into a solid in a step, as a share of the separation: poses are rounded."""

# strain
MAX_STRAIN = wp.constant(0.2)
"""Largest strain by contacts of which the stage does not warn."""
COMPRESSION = wp.constant(0.25)
"""What compression of cloth counts, as a share of the same elongation."""
SOLID = wp.constant(1.0 / 3.0)
"""The same of the strain of a soft body."""

# contacts inside the solve of Style3D
INNER_STIFFNESS = wp.constant(200.0)
"""Stiffness of a contact, in multiples of the mass that it moves by the squared length of the step: weight moves it by
14 micrometres at 1/60 s. Between 200 and 1000 results hardly differ."""
SLOWEST_SLIP = wp.constant(0.01)
"""Speed of slip below which friction falls in proportion [m/s]."""

# rigid shapes
SEGMENTS = 32
"""Triangles around a round shape; a multiple of four."""

# capacities
PAIRS_PER_FACE, PAIRS_PER_STATIC_FACE = 96, 2
"""Capacity of the detector's queues on a GPU, for each face that can move, and for others, which have pairs with those
alone: queues of a CUDA graph cannot grow. Four sheets of cloth that lie on each other have some 50, and up to 160 in a
Newton step in which they land."""
MOST_PAIRS_PER_FACE, MOST_FACE_PAIRS = 512, 2**30
"""Pairs of faces whose swept boxes overlap, up to which a GPU looks for proximities: for each face, and all (8 GB)."""
CANDIDATES_OF_CONTACT_IF_FEW = 32
"""Candidates for each contact for which there is room on a GPU where contacts are few, as behind a solver that leaves
none."""
DIVIDING_PLANES, DIVIDING_PLANES_IF_FEW = 32, 8
"""Capacity for dividing planes, for each particle: a pile of 30 sheets takes 9. The second where contacts are few."""
ITERATIONS_RESERVED, ITERATIONS_RESERVED_IF_FEW = 3, 1
"""Iterations for whose contacts constraints are reserved. In a CUDA graph, proximities use those of all but one."""
CONTACTS_PER_PARTICLE, MIN_CONTACTS = 8, 4096
"""Contacts that a report lists, for each particle, and at least."""
THREADS = 2048
"""Threads, for each multiprocessor of a GPU, of a launch over the entries of a queue."""

# iterations and sweeps
MAX_ITERATIONS = 40
"""Iterations of detect and project, after which vertices that still collide are divided."""
MAX_STUCK_ITERATIONS = wp.constant(4)
"""The same in worlds in which a vertex collides that was frozen in one of the last ``STUCK_STEPS`` steps."""
STUCK_STEPS = wp.constant(16)
"""Steps for which a vertex that was frozen is expected to be so again: rollers catch rows of cloth by turns."""
MAX_SLOW_ITERATIONS = 1
"""The same in worlds without fast contacts: division hardly moves slow elements, and costs no sweeps."""
MAX_DIVISIONS = 32
"""Iterations of detect and divide, after which vertices that still collide are frozen, see :mod:`.solve.division`."""
MAX_PASSES = wp.constant(4)
"""Passes over dividing planes in each division: sheets that fall together by more than they are apart need several."""
MAX_CUTS = wp.constant(64)
"""Sweeps over tetrahedra that cut paths, before a detection looks for what collides for that."""
MAX_SWEEPS, SWEEPS_PER_BATCH = wp.constant(40), wp.constant(4)
"""Sweeps over constraints, in each iteration on positions, and at the end on velocities; and the sweeps over one active
set, after which the device checks whether a constraint is still active."""
SLOW_POSITION_SWEEPS = 4
"""Sweeps on positions over constraints that move no body in worlds without fast contacts: division resolves what they
leave. Velocities need more, as a sweep passes an impulse on by a sheet."""
