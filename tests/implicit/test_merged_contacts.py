"""Contacts of one vertex pair, or of a vertex and an edge, are one in the solve of SolverImplicit: their sum."""

import newton
import numpy as np
import pytest
import warp as wp

import warp_bsc as bsc
from warp_bsc.implicit.contact.merge import link_contact, merge_contact
from warp_bsc.implicit.contact.system import Contacts

VERTICES = 25


@wp.kernel(enable_backward=False)
def _link(contacts: Contacts):
    i = wp.tid()
    link_contact(contacts, 0, i, contacts.corners[i], wp.vec4d(contacts.weights[i]))


@wp.kernel(enable_backward=False)
def _merge(contacts: Contacts):
    k = wp.tid()
    merge_contact(k // contacts.parts, k % contacts.parts, 0, contacts)


def contacts_of_step(device, **options):
    """Contacts after a step of a fan that slides over the middle of another, and of one over the edge of a roof.

    By name, in the order of their keys.
    """
    angle = np.pi / 3.0 * np.arange(6)
    ring = 0.05 * np.stack([np.cos(angle), np.sin(angle), np.full(6, 0.4)], axis=1)
    fan = np.concatenate([np.zeros((1, 3)), ring])
    of_fan = np.array([[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)])
    roof = np.array([[-0.04, 0.0, 0.0], [0.06, 0.0, 0.0], [0.0, 0.05, -0.04], [0.0, -0.05, -0.04]])
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for x, faces, at, speed in (
        (fan, of_fan, (0.0, 0.0, 0.0005), 0.05),
        (-fan, of_fan, (0.0, 0.0, 0.0), 0.0),
        (fan, of_fan, (1.0, 0.0, 0.0006), 0.07),
        (roof, np.array([[0, 1, 2], [1, 0, 3]]), (1.0, 0.0, 0.0), 0.0),
    ):
        builder.add_cloth_mesh(
            pos=wp.vec3(*at), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.2 * speed, speed, -0.01), density=0.2,
            vertices=[wp.vec3(*v) for v in x], indices=faces.ravel().tolist(), tri_ke=1e3, tri_ka=1e3,
        )  # fmt: skip
    model = builder.finalize(device=device)
    solver, state = bsc.SolverImplicit(model, friction=0.3, **options), model.state()
    solver.step(state, state, None, None, 1.0 / 240.0)
    found = solver.newton_method.problem.contacts
    count = found.count.numpy()[0]
    order = np.argsort(found.key.numpy()[:count])
    names = "corners", "weights", "normal", "gradient", "hessian", "limit", "key", "couples"
    return {name: getattr(found, name).numpy()[:count][order] for name in names}


@pytest.fixture(scope="module")
def contacts(device):
    """Those at the end of the step, which are reported: each pair's own."""
    return contacts_of_step(device, report=["contacts"])


def merged(contacts, device, order):
    """Merges contacts that are found in an order; returns those that are left, in the order of their keys."""
    count, struct = len(order), Contacts()
    for name, values in contacts.items():
        setattr(struct, name, wp.array(values[order], dtype=Contacts.vars[name].type.dtype, device=device))
    struct.feature = wp.zeros(count, dtype=wp.vec3i, device=device)
    struct.parts = 8 if device.is_cuda else 1
    struct.next, struct.bucket = (wp.zeros(n, dtype=int, device=device) for n in (count, struct.parts))
    struct.first_bucket = wp.array([0, 1], dtype=int, device=device)
    wp.launch(_link, count, inputs=[struct], device=device)
    wp.launch(_merge, count * struct.parts, inputs=[struct], device=device)
    left = np.flatnonzero(struct.weights.numpy().any(axis=1))
    left = left[np.argsort(struct.key.numpy()[left])]
    assert struct.couples.numpy().sum() == len(left)
    return {name: getattr(struct, name).numpy()[left] for name in contacts}


def sums(contacts):
    """The gradient and the Hessian of all contacts by all vertices, and the friction at each."""
    gradient, hessian = np.zeros((VERTICES, 3)), np.zeros((VERTICES, 3, VERTICES, 3))
    limits = np.zeros(VERTICES)
    names = "corners", "weights", "gradient", "hessian", "limit"
    for corners, weights, g, h, limit in zip(*(contacts[name] for name in names), strict=True):
        np.add.at(gradient, corners, np.outer(weights, g))
        np.add.at(limits, corners, np.abs(weights) * limit)
        for a, w in zip(corners, weights, strict=True):
            for b, x in zip(corners, weights, strict=True):
                hessian[a, :, b] += w * x * h[:, :3]  # rows have a fourth number without meaning
    return gradient, hessian, limits


def test_contacts_of_a_feature_are_their_sum(contacts, device):
    count = len(contacts["key"])
    assert count == 48 + 8
    found = merged(contacts, device, np.arange(count))
    assert len(found["key"]) == 2
    for actual, expected in zip(sums(found), sums(contacts), strict=True):
        np.testing.assert_allclose(actual, expected, atol=2e-6 * np.abs(expected).max())
    gradient = np.abs(sums(contacts)[0])
    assert gradient[:, :2].max() > 0.05 * gradient.max()  # friction


def test_a_solve_takes_one_contact_of_a_feature(device):
    in_solve = contacts_of_step(device)
    assert len(in_solve["key"]) == 48 + 8
    assert (in_solve["weights"].any(axis=1).sum(), in_solve["couples"].sum()) == (2, 2)


def test_sums_do_not_depend_on_the_order_of_contacts(contacts, device):
    """Large forces that cancel, and small ones: sums of doubles do depend on it."""
    of_fans = contacts["corners"].max(axis=1) < 14
    changed, random = {name: values[of_fans] for name, values in contacts.items()}, np.random.default_rng(1)
    size = np.repeat(random.uniform(0.5, 1.0, 12), 4) * np.resize([1.0, 1e-12, -1.0, 3e-13], 48)
    size *= np.sign(changed["normal"][:, 2])
    changed["gradient"] = (size[:, None] * changed["normal"][0]).astype(np.float32)
    first, *others = (merged(changed, device, random.permutation(48)) for _ in range(4))
    for other in others:
        for name, values in other.items():
            np.testing.assert_array_equal(values, first[name])


def test_sums_do_not_depend_on_what_else_is_in_a_bucket(contacts, device):
    """As worlds are solved together: large forces of others change no bit."""
    of_fans = contacts["corners"].max(axis=1) < 14
    both = {name: values.copy() for name, values in contacts.items()}
    both["gradient"][~of_fans] *= 1e8
    both["gradient"][of_fans] *= np.resize(np.float32([1.0, 1e-6, 1e-5]), (48, 1))
    alone = {name: values[of_fans] for name, values in both.items()}
    together = merged(both, device, np.arange(len(of_fans)))
    is_fan = together["corners"].max(axis=1) < 14
    for name, values in merged(alone, device, np.arange(48)).items():
        np.testing.assert_array_equal(together[name][is_fan], values)
