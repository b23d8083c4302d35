"""Gradients through rigid bodies, against central differences: of a step by all that it reads, and of a rollout."""

import newton
import numpy as np
import pytest
import warp as wp

import warp_bsc as bsc

DT = 0.01


class Still(newton.solvers.SolverBase):
    """An inner solver that does nothing: states at the end are given."""

    def step(self, state_in, state_out, control, contacts, dt):
        pass


def add_triangles(builder, vertices):
    """Separate triangles of cloth."""
    builder.add_cloth_mesh(
        pos=wp.vec3(),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(),
        vertices=[wp.vec3(*vertex) for vertex in vertices],
        indices=[*range(len(vertices))],
        density=1.0,
    )


def wedge(builder, at, **options):
    """A body with a tetrahedron as its shape, off its centre of mass, of mass 0.5 kg."""
    inertia = np.array([[0.03, 0.004, -0.002], [0.004, 0.05, 0.003], [-0.002, 0.003, 0.04]])
    rotation = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, -0.5)), 0.4)
    body = builder.add_body(
        xform=wp.transform(wp.vec3(*at), rotation),
        mass=0.5,
        inertia=wp.mat33(*inertia.ravel().tolist()),
        com=wp.vec3(0.02, -0.03, 0.05),
        lock_inertia=True,
        **options,
    )
    points = np.array([(0.0, 0.0, -0.2), (0.25, 0.1, 0.1), (-0.2, 0.2, 0.1), (0.0, -0.25, 0.12)], dtype=np.float32)
    mesh = newton.Mesh(points, np.array([0, 2, 1, 0, 3, 2, 0, 1, 3, 1, 2, 3]), compute_inertia=False)
    builder.add_shape_mesh(body, mesh=mesh, cfg=newton.ModelBuilder.ShapeConfig(mu=0.4, density=0.0))
    return body


SHEET = [(-0.6, -0.5, 0.0), (0.7, -0.4, 0.02), (0.1, 0.8, -0.01)]
FLYING = [(0.3, 0.3, 0.5), (0.5, 0.4, 0.62), (0.45, 0.1, 0.7)]


class Step:
    """One step of a scene whose start and wanted end are given, and everything that it reads, as numbers."""

    def __init__(self, device, *, kinematic=False, projections=None, spin=1.0, friction=0.5, restitution=0.4):
        builder = newton.ModelBuilder()
        add_triangles(builder, SHEET)
        wedge(builder, (0.05, 0.02, 0.25), is_kinematic=kinematic)
        self.model = model = builder.finalize(device=device, requires_grad=True)
        self.friction, self.restitution = (
            wp.array([value], dtype=float, device=device, requires_grad=True) for value in (friction, restitution)
        )
        self.solver = bsc.SolverCCD(Still(model), friction=self.friction, restitution=self.restitution, bodies=True)
        if projections is not None:
            self.solver._response.max_iterations = projections
        self.states = start, end = model.state(), model.state()
        wanted = end.body_q.numpy()
        wanted[0, :3] += (0.02, -0.01, -0.07)
        turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, -0.4, 2.0)), 0.2 * spin)
        wanted[0, 3:] = np.array(turn * wp.quat(*wanted[0, 3:].tolist()))
        q = start.particle_q.numpy()
        random = np.random.default_rng(1)
        self.arrays = {
            "start_q": start.particle_q,
            "particle_q": end.particle_q,
            "particle_qd": end.particle_qd,
            "start_body_q": start.body_q,
            "body_q": end.body_q,
            "body_qd": end.body_qd,
            "particle_inv_mass": model.particle_inv_mass,
            "body_inv_mass": model.body_inv_mass,
            "body_inv_inertia": model.body_inv_inertia,
            "body_mass": model.body_mass,
            "body_inertia": model.body_inertia,
            "friction": self.friction,
            "mu": model.shape_material_mu,
            "restitution": self.restitution,
        }
        self.values = {name: array.numpy().astype(np.float32) for name, array in self.arrays.items()}
        self.values["particle_q"] = q + random.normal(scale=0.004, size=q.shape) + (0.0, 0.0, 0.01)
        self.values["particle_qd"] = (self.values["particle_q"] - q) / DT + random.normal(scale=0.1, size=q.shape)
        self.values["body_q"] = wanted
        twist = np.array([[2.0, -1.0, -7.0, 8.0 * spin, -3.0 * spin, 16.0 * spin]])
        self.values["body_qd"] = twist + random.normal(scale=0.1, size=(1, 6))
        self.values = {name: value.astype(np.float32).astype(float) for name, value in self.values.items()}
        self.results = "particle_q", "particle_qd", "body_q", "body_qd"

    def assign(self, values):
        for name, array in self.arrays.items():
            array.assign(values[name].astype(np.float32))
        self.model.particle_mass.assign(1.0 / values["particle_inv_mass"])
        self.solver.notify_model_changed(0)

    def end(self, values):
        self.assign(values)
        self.solver.step(*self.states, None, None, DT)
        return {name: self.arrays[name].numpy().astype(float) for name in self.results}

    def gradients(self, cotangents):
        self.assign(self.values)
        tape = wp.Tape()
        with tape:
            self.solver.step(*self.states, None, None, DT)
        for array in self.arrays.values():
            array.grad.zero_()
        for name, cotangent in cotangents.items():
            self.arrays[name].grad.assign(cotangent.astype(np.float32))
        tape.backward()
        return {name: array.grad.numpy().astype(float) for name, array in self.arrays.items()}

    def directions(self, random):
        """For each input, a direction and the step of its difference; poses turn by a tangent direction."""
        for name, value in self.values.items():
            h = 2.0**-13
            direction = random.integers(-2, 3, size=value.shape).astype(float)
            if name in ("particle_qd", "body_qd"):
                h = 2.0**-6
            elif name in ("body_inertia", "body_inv_inertia"):
                direction = direction + direction.swapaxes(-1, -2)
                h *= 0.1 if name == "body_inertia" else 100.0
            elif name in ("particle_inv_mass", "body_inv_mass", "body_mass"):
                h *= np.abs(value).max() * 8.0
                direction = random.choice([-2.0, -1.0, 1.0, 2.0], size=value.shape)
            elif name in ("friction", "mu", "restitution"):
                h *= 32.0
                direction = np.ones(value.shape)
            elif name in ("body_q", "start_body_q"):
                q = value[:, 3:]
                direction[:, 3:] -= (direction[:, 3:] * q).sum(axis=1, keepdims=True) * q
            yield name, h, direction


def check_step(scene, *, draws=3):
    """Compares the gradients of a step with central differences."""
    end = scene.end(scene.values)
    random = np.random.default_rng(0)
    for _ in range(draws):
        cotangents = {
            name: random.normal(size=value.shape) * (DT if name.endswith("qd") else 1.0) for name, value in end.items()
        }
        gradients = scene.gradients(cotangents)
        for name, h, direction in scene.directions(random):
            sides = []
            for sign in (1.0, -1.0):
                values = dict(scene.values)
                values[name] = values[name] + sign * h * direction
                result = scene.end(values)
                sides.append(sum((result[key] * cotangents[key]).sum() for key in result))
            expected = (sides[0] - sides[1]) / (2.0 * h)
            actual = (gradients[name] * direction).sum()
            print(f"{name:18s} {actual:14.6f} {expected:14.6f}  {abs(actual - expected) / (abs(expected) + 1e-9):.1e}")


if __name__ == "__main__":
    import sys
    for kw in eval(sys.argv[1]):
        print(kw)
        s = Step("cpu", **kw)
        e = s.end(s.values)
        print({k: np.abs(e[k] - s.values[k]).max() for k in e}, s.solver.report.hits, s.solver.report.truncated, s.solver.report.certified, s.solver.report.rounds)
        check_step(s, draws=1)
