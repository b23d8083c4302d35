"""Holds the search for contacts on arcs against interval arithmetic: random screws of triangles, vertices and edges.

The table has, generator by generator, how many pairs collide, how many of these are missed, how many are reported that
do not collide, all of them within the tolerance, and the share that is decided over the whole step, without halving it.
It is a failure if a collision is missed, a time of impact is late, or a pair is reported that stays farther apart than
the tolerance. ``--detector 1000`` asks ``detect(rigid_motion=)`` about the first thousand pairs of each kind and
generator, too. It needs mpmath (extra ``dev``).
"""

import time
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from arc_intervals import HIT, UNDECIDED, Pairs, decide
from arc_truth import sampled_distances
from measured import print_rows

import warp_bsc as bsc
from warp_bsc.bench.tables import Column
from warp_bsc.detection.arcs.rigid_motion import points_on_arcs
from warp_bsc.detection.narrow.rules.arc import allocate_arcs, bound_arc
from warp_bsc.kernels.arcs import Arcs, impact_on_arcs
from warp_bsc.kernels.ccd import impact_at_distance
from warp_bsc.kernels.motion import query_of
from warp_bsc.kernels.pairs import distance_of_corners
from warp_bsc.kernels.signs import ROUNDOFF

KINDS = ("vertex_face", "edge_edge")
DEFAULT_TOLERANCE = 2.0**-29  # as a share of the largest coordinate
TIME_TOLERANCE = wp.constant(wp.float64(2.0**-20))


def rotation(turn):
    """The matrices of turns, shape [..., 3, 3]."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    k = turn / np.where(angle[..., 0] > 0.0, angle[..., 0], 1.0)
    cross = np.zeros((*turn.shape, 3))
    cross[..., [2, 0, 1], [1, 2, 0]], cross[..., [1, 2, 0], [2, 0, 1]] = k, -k
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def screws(rng, n):
    """Centres, turns of 0.001 to 12 rad and translations of two bodies each; one of three second bodies stands."""
    centre, turn, translation = (
        rng.uniform(-1, 1, (n, 2, 3)),
        rng.standard_normal((n, 2, 3)),
        rng.uniform(-1, 1, (n, 2, 3)),
    )
    turn *= 10.0 ** rng.uniform(-3, np.log10(12.0), (n, 2, 1)) / np.linalg.norm(turn, axis=-1, keepdims=True)
    still = rng.random(n) < 1.0 / 3.0
    turn[still, 1] = translation[still, 1] = 0.0
    return centre, turn, translation * 10.0 ** rng.uniform(-2, 0, (n, 1, 1))


def moved(x, centre, turn, translation, share):
    """Points of two bodies after a share of their screws, from their positions at the start."""
    return np.einsum("nbij,nbj->nbi", rotation(share * turn), x - centre) + centre + share * translation


def pairs_at(kind, rng, time, meeting, centre, turn, translation):
    """Pairs whose points are in given positions at a time, shape [n, 4, 3]."""
    body = Pairs(kind, meeting, meeting, centre, turn).body
    centres, turns, translations = centre[:, body], turn[:, body], translation[:, body]
    back = rotation(time[:, None, None] * turns).swapaxes(-1, -2)
    x0 = np.einsum("nbij,nbj->nbi", back, meeting - centres - time[:, None, None] * translations) + centres
    x1 = moved(x0, centres, turns, translations, 1.0)
    if rng.random() < 0.5:
        x0, x1 = (x.astype(np.float32).astype(float) for x in (x0, x1))
    return Pairs(kind, x0, x1, centre, turn)


def anywhere(kind, rng, n):
    """Elements of sizes around one, anywhere near each other."""
    return pairs_at(kind, rng, rng.uniform(0, 1, n), rng.uniform(-1, 1, (n, 4, 3)), *screws(rng, n))


def placed(kind, rng, n):
    """Points of pairs that meet, and the unit normal across them."""
    size = 10.0 ** rng.uniform(-2, 0, (n, 1, 1))
    x = rng.uniform(-1, 1, (n, 1, 3)) + size * rng.uniform(-1, 1, (n, 4, 3))
    if kind == "vertex_face":
        x[:, 0] = np.einsum("ni,nij->nj", rng.dirichlet((2.0, 2.0, 2.0), n), x[:, 1:])
        normal = np.cross(x[:, 2] - x[:, 1], x[:, 3] - x[:, 1])
    else:
        s, r = rng.uniform(0.05, 0.95, (2, n, 1))
        x[:, 2:] += (x[:, 0] + s * (x[:, 1] - x[:, 0]) - x[:, 2] - r * (x[:, 3] - x[:, 2]))[:, None]
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 3] - x[:, 2])
    return x, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def meeting(kind, rng, n):
    """Elements that meet at some time."""
    return pairs_at(kind, rng, rng.uniform(0.01, 0.99, n), placed(kind, rng, n)[0], *screws(rng, n))


def near_miss(kind, rng, n):
    """Elements that are 1e-10 to 1e-2 apart at some time, or as far into each other."""
    x, normal = placed(kind, rng, n)
    first = 1 if kind == "vertex_face" else 2
    x[:, :first] += (rng.choice([-1, 1], (n, 1)) * 10.0 ** rng.uniform(-10, -2, (n, 1)) * normal)[:, None]
    return pairs_at(kind, rng, rng.uniform(0, 1, n), x, *screws(rng, n))


def tip(kind, rng, n):
    """Tips that reach a wall at one moment of a turn, by 1e-9 to 1e-2, or stay as far away."""
    angle, depth = rng.uniform(0.05, 2.5, n), rng.choice([-1, 1], n) * 10.0 ** rng.uniform(-9, -2, n)
    time, radius = rng.uniform(0.05, 0.95, n), rng.uniform(0.2, 2.0, n)
    x, zero = np.zeros((n, 4, 3)), np.zeros(n)
    wall = radius - depth
    if kind == "vertex_face":
        x[:, 0, 0] = radius
        x[:, 1:] = [[0, -2, -2], [0, 2, -1], [0, 0.3, 3]]
        x[:, 1:, 0] = wall[:, None]
    else:
        x[:, :2] = np.stack([np.stack([radius, zero, zero - 1], -1), np.stack([radius, zero, zero + 0.7], -1)], 1)
        x[:, 2:] = np.stack([np.stack([wall, zero - 1, zero], -1), np.stack([wall, zero + 2, zero], -1)], 1)
    turn, still = np.zeros((n, 2, 3)), np.zeros((n, 2, 3))
    turn[:, 0, 2] = angle
    spin = rotation(rng.standard_normal((n, 3)))
    x, turn = np.einsum("nij,npj->npi", spin, x), np.einsum("nij,npj->npi", spin, turn)
    return pairs_at(kind, rng, time, x, still, turn, still)


GENERATORS = {"anywhere": anywhere, "meeting": meeting, "near miss": near_miss, "tip": tip}


@wp.kernel(enable_backward=False, module_options={"fuse_fp": False}, module="unique")
def _bound(x0: wp.array[wp.vec3d], x1: wp.array[wp.vec3d], arcs: Arcs):
    bound_arc(arcs, wp.tid(), x0[wp.tid()], x1[wp.tid()])


@wp.kernel(enable_backward=False, module_options={"fuse_fp": False}, module="unique")
def _search(
    kind: int,
    x0: wp.array[wp.vec3d],
    x1: wp.array[wp.vec3d],
    arcs: Arcs,
    status: wp.array[int],
    at_once: wp.array[int],
    toi: wp.array[wp.float64],
):
    """Searches each pair, and whether the chords over the whole step are enough to decide it."""
    i = wp.tid()
    v = wp.vec4i(4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3)
    a0, b0, c0, d0 = x0[v[0]], x0[v[1]], x0[v[2]], x0[v[3]]
    a1, b1, c1, d1 = x1[v[0]], x1[v[1]], x1[v[2]], x1[v[3]]
    query = query_of(a0, b0, c0, d0, a1, b1, c1, d1)
    found = impact_on_arcs(kind, v, query, arcs, wp.float64(0.0))
    within = distance_of_corners(kind, v, arcs.deviation)
    whole = impact_at_distance(kind, a0, b0, c0, d0, a1, b1, c1, d1, within, ROUNDOFF, False, TIME_TOLERANCE)
    status[i] = found.status
    toi[i] = found.toi
    at_once[i] = wp.where(whole.status == 0, 1, 0)


def search(pairs, device):
    """Status and time of impact of each pair, and whether the whole step decides it."""
    n = len(pairs)
    body = (2 * np.arange(n)[:, None] + pairs.body).ravel()
    arcs = allocate_arcs(body, 2 * n, device)
    arcs.centre.assign(pairs.centre.reshape(-1, 3))
    arcs.turn.assign(pairs.turn.reshape(-1, 3))
    x0, x1 = (wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device=device) for x in (pairs.x0, pairs.x1))
    wp.launch(_bound, 4 * n, inputs=[x0, x1, arcs], device=device)
    status, at_once = (wp.zeros(n, dtype=int, device=device) for _ in range(2))
    toi = wp.zeros(n, dtype=wp.float64, device=device)
    inputs = [KINDS.index(pairs.kind), x0, x1, arcs]
    wp.launch(_search, n, inputs=inputs, outputs=[status, at_once, toi], device=device)
    return status.numpy(), toi.numpy(), at_once.numpy() == 1


def detect(pairs, device):
    """The pairs that ``detect(rigid_motion=)`` reports, each in its own world, their times of impact, tolerance."""
    n = len(pairs)
    first = 4 * np.arange(n)[:, None]
    body = (2 * np.arange(n)[:, None] + pairs.body).ravel()
    motion = bsc.RigidMotion(body, pairs.centre.reshape(-1, 3), pairs.turn.reshape(-1, 3), tolerance=1e-3)
    options = {"world": np.repeat(np.arange(n), 4), "device": device}
    if pairs.kind == "vertex_face":
        faces = np.concatenate([first + np.array([1, 2, 3]), first + np.zeros(3, dtype=int)])
        mesh = bsc.CollisionMesh(faces, 4 * n, **options)
    else:
        edges = np.concatenate([first + np.array([0, 1]), first + np.array([2, 3])])
        mesh = bsc.CollisionMesh(np.zeros((0, 3), dtype=int), 4 * n, edges=edges, **options)
    found = bsc.CollisionDetector(mesh).detect(pairs.x0.reshape(-1, 3), pairs.x1.reshape(-1, 3), rigid_motion=motion)
    rows = getattr(found, pairs.kind)
    of_pair = (rows[:, 0] if pairs.kind == "vertex_face" else mesh.edges[rows[:, 0], 0]) // 4
    status, toi = np.zeros(n, dtype=int), np.full(n, 2.0)
    status[of_pair] = 1
    np.minimum.at(toi, of_pair, getattr(found, f"{pairs.kind}_toi"))
    return status, toi, motion.tolerance


def least_distances(pairs):
    """The least distance of each pair, about: by samples, ever closer around the smallest."""
    n, samples = len(pairs), 257
    if not n:
        return np.zeros(0)
    body = (2 * np.arange(n)[:, None] + pairs.body).ravel()
    motion = bsc.RigidMotion(body, pairs.centre.reshape(-1, 3), pairs.turn.reshape(-1, 3))
    x0, x1 = pairs.x0.reshape(-1, 3), pairs.x1.reshape(-1, 3)
    low, high = np.zeros(n), np.ones(n)
    for _ in range(7):
        times = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, samples)
        vertices = np.broadcast_to(np.arange(4 * n).reshape(n, 1, 4), (n, samples, 4))
        points = points_on_arcs(motion, x0, x1, vertices, times[:, :, None])
        distance = sampled_distances(pairs.kind, points)
        best, step = distance.argmin(axis=1), (high - low) / (samples - 1)
        at = times[np.arange(n), best]
        low, high = np.maximum(at - 2.0 * step, 0.0), np.minimum(at + 2.0 * step, 1.0)
    return distance.min(axis=1)


@dataclass
class Verdict:
    """How the answers compare with the truth: numbers of pairs."""

    pairs: int = 0
    colliding: int = 0
    undecided: int = 0  # by the truth: they touch to within all digits
    missed: int = 0
    late: int = 0  # time of impact after a part with a collision
    false: int = 0  # reported, but free, and within the tolerance
    beyond: int = 0  # reported, but free, and farther apart
    unsure: int = 0
    at_once: int = 0  # decided over the whole step

    def __add__(self, other):
        return Verdict(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def judge(pairs, truth, status, toi, tolerance, at_once):
    """Compares answers with the truth."""
    reported, collides = status != 0, truth.status == HIT
    false = np.flatnonzero(reported & (truth.status == 0))
    allowed = np.broadcast_to(tolerance, len(pairs))[false]
    beyond = least_distances(pairs.rows(false)) > allowed
    return Verdict(
        pairs=len(pairs),
        colliding=int(collides.sum()),
        undecided=int((truth.status == UNDECIDED).sum()),
        missed=int((collides & ~reported).sum()),
        late=int((collides & reported & (toi > truth.before)).sum()),
        false=len(false) - int(beyond.sum()),
        beyond=int(beyond.sum()),
        unsure=int((status == 2).sum()),
        at_once=int(at_once.sum()),
    )


def certify(count, seed, device, *, of_detector=0, chunk=12500):
    """Verdicts of the search and of the detector, by generator, for about ``count`` pairs in all."""
    rng = np.random.default_rng(seed)
    each = -(-count // (len(GENERATORS) * len(KINDS)))
    searches, detections = {}, {}
    for name, generate in GENERATORS.items():
        for kind in KINDS:
            left, asked = each, of_detector
            while left:
                pairs = generate(kind, rng, min(left, chunk))
                left -= len(pairs)
                truth = decide(pairs)
                largest = np.maximum(np.abs(pairs.x0), np.abs(pairs.x1)).max(axis=(1, 2))
                status, toi, at_once = search(pairs, device)
                verdict = judge(pairs, truth, status, toi, 1.01 * DEFAULT_TOLERANCE * largest + 1e-11, at_once)
                searches[name] = searches.get(name, Verdict()) + verdict
                some = slice(0, min(asked, len(pairs)))
                if asked:
                    asked -= some.stop
                    rows = pairs.rows(some)
                    truth.status, truth.before = truth.status[some], truth.before[some]
                    found = judge(rows, truth, *detect(rows, device), np.zeros(len(rows), dtype=bool))
                    detections[name] = detections.get(name, Verdict()) + found
    return searches, detections


OPTIONS = {
    "--detector": {"type": int, "default": 0, "help": "pairs of each kind and generator for detect(rigid_motion=)"},
    "--device": {"default": None},
}


def run(arguments):
    """Certifies as the options say, prints tables, and returns the number of failures."""
    start = time.perf_counter()
    device = wp.get_device(arguments.device)
    searches, detections = certify(arguments.count, arguments.seed, device, of_detector=arguments.detector)
    wrong = 0
    columns = [Column(f.name, f.name, "d") for f in fields(Verdict)]
    at_once = Column("without halving", lambda verdict: verdict.at_once / verdict.pairs, ".1%")
    for title, verdicts, more in (("search of a pair", searches, [at_once]), ("detect(rigid_motion=)", detections, [])):
        if verdicts:
            total = sum(verdicts.values(), Verdict())
            print_rows(title, [*columns, *more], verdicts.items(), total=total)
            wrong += total.missed + total.late + total.beyond
    print(f"{time.perf_counter() - start:.0f} s")
    return wrong
