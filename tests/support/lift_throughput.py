"""Measures how many steps of an environment a second solvers take in which robots lift cloths.

    pip install "newton[sim]"
    python tests/support/lift_throughput.py --worlds 64 1024

The scene, its numbers and its coupling are those of the lift of cloth in Isaac Lab 3.0.0, with a gripper on a carriage
in place of the arm: MuJoCo moves the gripper, and another solver the cloth, with proxies of the fingers. Cloths lie on
two supports, at random places. Two fingers with a limit of their effort close on the part beyond the supports, and lift
it. Each world starts anew when its episode ends, or by chance. A step of an environment is four of 1/120 s, of two
substeps each. On a GPU it is a CUDA graph. The exact detector counts edges that cross faces once a tenth of the steps.
``--json`` writes the rows to a file as well.
"""

import argparse
import time

import newton
import warp as wp
from measured import write_measurement
from newton.solvers.experimental.coupled import SolverCoupled, SolverCoupledProxy

import warp_bsc as bsc
from warp_bsc.bench.crossings import CrossingCounter

SIDE, CELLS = 0.2, 8  # m and cells, of a side of the cloth: 128 triangles
CLOTH = {"tri_ke": 5e2, "tri_ka": 5e2, "tri_kd": 1e-3, "edge_ke": 0.5, "edge_kd": 1e-3, "particle_radius": 0.002}
DENSITY = 1.0  # kg/m^2
SUPPORT = (0.05, 0.01, 0.075)  # m, half the lengths of the sides of each of two
TOP = 2.0 * SUPPORT[2]  # m
LOWEST, HIGHEST = 0.01, 0.03  # m, of a cloth above the supports at the start
SHIFT = 0.01  # m, by which a cloth is shifted at most
FINGER, FINGER_MASS, CARRIAGE_MASS = (0.01, 0.01, 0.005), 0.015, 1.0  # m (halves) and kg
ACROSS = 0.085  # m, of the fingers from the middle of the supports
OPENING, LIFT = 0.04, 0.15  # m
DRIVE = {"target_ke": 2000.0, "target_kd": 100.0, "effort_limit": 500.0, "armature": 0.1}
CONTACT = {"soft_contact_ke": 8e3, "soft_contact_kd": 1e-2, "soft_contact_mu": 10.0, "particle_mu": 10.0}
MARGIN = 2e-3  # m, that solvers of the cloth keep it off fingers, more than those move before they feel it: 1.25 mm
DT, SUBSTEPS, DECIMATION = 1.0 / 120.0, 2, 4
CLOSING, LIFTING, END = 0.4, 0.7, 1.6  # s, when fingers close, when they lift, and when an episode ends
LIFTED = TOP + 0.06  # m: a cloth whose particles are higher than that in the mean is lifted
CHANCE = 1.0 / 150.0  # that a world starts anew in a step of the environment


@wp.struct
class Episodes:
    """The episodes of worlds.

    Attributes:
        time: Time of each [s].
        number: Episodes of each so far.
        resets: Worlds that start anew in this step, and False for what is in all.
        ended, lifted: Numbers of episodes that have ended at their end, and of those whose cloth was lifted.
    """

    time: wp.array[float]
    number: wp.array[int]
    resets: wp.array[wp.bool]
    ended: wp.array[int]
    lifted: wp.array[int]


@wp.kernel(enable_backward=False)
def begin(particle_q: wp.array[wp.vec3], particles: int, episodes: Episodes):
    """Ends episodes, and says which worlds start anew."""
    world = wp.tid()
    random = wp.rand_init(episodes.number[world], world)
    ends = episodes.time[world] >= END
    if ends:
        height = float(0.0)
        for i in range(particles):
            height += particle_q[world * particles + i][2] / float(particles)
        wp.atomic_add(episodes.ended, 0, 1)
        if height > LIFTED:
            wp.atomic_add(episodes.lifted, 0, 1)
    resets = ends or wp.randf(random) < CHANCE
    episodes.resets[world] = resets
    episodes.number[world] += 1
    if resets:
        episodes.time[world] = 0.0


@wp.kernel(enable_backward=False)
def put_cloth(
    start: wp.array[wp.vec3],
    particles: int,
    episodes: Episodes,
    # out
    particle_q: wp.array[wp.vec3],
    particle_qd: wp.array[wp.vec3],
):
    """Puts a cloth to its place at the start."""
    i = wp.tid()
    world = i // particles
    if episodes.resets[world]:
        random = wp.rand_init(17 + episodes.number[world], world)
        x, y = wp.randf(random, -SHIFT, SHIFT), wp.randf(random, -SHIFT, SHIFT)
        particle_q[i] = start[i] + wp.vec3(x, y, wp.randf(random, LOWEST, HIGHEST))
        particle_qd[i] = wp.vec3()


@wp.kernel(enable_backward=False)
def put_gripper(episodes: Episodes, joint_q: wp.array[float], joint_qd: wp.array[float]):
    """Puts a gripper to its place at the start: three joints of each world."""
    i = wp.tid()
    if episodes.resets[i // 3]:
        joint_q[i] = 0.0
        joint_qd[i] = 0.0


@wp.kernel(enable_backward=False)
def drive(dt: float, episodes: Episodes, joint_target_q: wp.array[float]):
    """Sets what the gripper of a world is driven to."""
    world = wp.tid()
    t = episodes.time[world] + dt
    episodes.time[world] = t
    joint_target_q[3 * world] = LIFT * wp.clamp(2.0 * (t - LIFTING), 0.0, 1.0)
    closed = OPENING * wp.clamp(5.0 * (t - CLOSING), 0.0, 1.0)
    joint_target_q[3 * world + 1] = closed
    joint_target_q[3 * world + 2] = closed


def build_world():
    """Returns a builder of a world: cloth, supports, and a gripper."""
    world, cell = newton.ModelBuilder(), SIDE / CELLS
    world.add_ground_plane()
    slippery = newton.ModelBuilder.ShapeConfig(mu=0.01)
    for y in (-0.02, 0.02):
        at = wp.transform(wp.vec3(0.0, y, SUPPORT[2]), wp.quat_identity())
        world.add_shape_box(-1, xform=at, hx=SUPPORT[0], hy=SUPPORT[1], hz=SUPPORT[2], cfg=slippery)
    world.add_cloth_grid(
        pos=wp.vec3(-0.5 * SIDE, -0.5 * SIDE, TOP),
        rot=wp.quat_identity(),
        vel=wp.vec3(),
        dim_x=CELLS,
        dim_y=CELLS,
        cell_x=cell,
        cell_y=cell,
        mass=DENSITY * SIDE**2 / (CELLS + 1) ** 2,
        **CLOTH,
    )
    height = TOP + 0.5 * FINGER[2]
    middle = wp.transform(wp.vec3(0.0, ACROSS, height), wp.quat_identity())
    carriage = world.add_link(xform=middle, mass=CARRIAGE_MASS, inertia=wp.diag(wp.vec3(1e-3)), lock_inertia=True)
    up = {"axis": (0.0, 0.0, 1.0), "target_ke": 2e4, "target_kd": 5e2}
    joints = [world.add_joint_prismatic(-1, carriage, parent_xform=middle, **up)]
    for side in (-1.0, 1.0):
        offset = side * (OPENING + FINGER[2])
        at = wp.transform(wp.vec3(0.0, ACROSS, height + offset), wp.quat_identity())
        inertia = wp.diag(wp.vec3(FINGER_MASS / 3.0 * 2e-4))
        finger = world.add_link(xform=at, mass=FINGER_MASS, inertia=inertia, lock_inertia=True)
        rough = newton.ModelBuilder.ShapeConfig(mu=1.0, density=0.0)
        world.add_shape_box(finger, hx=FINGER[0], hy=FINGER[1], hz=FINGER[2], cfg=rough)
        on_carriage = wp.transform(wp.vec3(0.0, 0.0, offset), wp.quat_identity())
        limits = {"axis": (0.0, 0.0, -side), "limit_lower": -0.01, "limit_upper": OPENING - 2e-4}
        joints.append(world.add_joint_prismatic(carriage, finger, parent_xform=on_carriage, **limits, **DRIVE))
    world.add_articulation(joints)
    return world


def build(worlds):
    """Returns a model of worlds."""
    builder = newton.ModelBuilder()
    builder.replicate(build_world(), worlds)
    builder.color()
    model = builder.finalize()
    for name, value in CONTACT.items():
        setattr(model, name, value)
    return model


def vbd(model, self_contact=False):
    """Returns VBD with ten iterations."""
    contact = {"particle_self_contact_margin": 0.01, "particle_self_contact_gap": 0.004} if self_contact else {}
    return newton.solvers.SolverVBD(model, iterations=10, particle_enable_self_contact=self_contact, **contact)


SOLVERS = {
    "VBD": vbd,
    "VBD, self-contact": lambda model: vbd(model, self_contact=True),
    "SolverCCD(VBD)": lambda model: bsc.SolverCCD(vbd(model), min_distance=MARGIN),
    "SolverImplicit": lambda model: bsc.SolverImplicit(model, min_distance=MARGIN),
}
"""What makes the solver of the cloth. Ours need none of Newton's contacts, and a stage around the coupled solver."""


def collide(model):
    """Returns the collision pipeline that Isaac Lab gives the coupling."""
    return newton.CollisionPipeline(model, enable_rigid_soft_full_surface_contact=True)


def couple(model, name):
    """Returns MuJoCo for the grippers, and a solver of the cloth with proxies of their fingers."""
    bodies, joints = list(range(model.body_count)), list(range(model.joint_count))
    fingers = [body for body in bodies if body % 3]
    robot = SolverCoupled.Entry(
        name="rigid",
        solver=lambda view: newton.solvers.SolverMuJoCo(
            view, disable_contacts=True, cone="elliptic", ls_iterations=50, integrator="implicitfast"
        ),
        bodies=bodies,
        joints=joints,
    )
    cloth = SolverCoupled.Entry(name="soft", solver=SOLVERS[name], particles=list(range(model.particle_count)))
    is_ours = name.startswith("Solver")
    options = {"mode": "staggered"} if is_ours else {"collision_pipeline": collide, "collide_interval": 1}
    proxy = SolverCoupledProxy.Proxy(source="rigid", destination="soft", bodies=fingers, **options)
    coupled = SolverCoupledProxy(model, [robot, cloth], SolverCoupledProxy.Config(proxies=[proxy], iterations=1))
    return bsc.SolverCCD(coupled) if is_ours else coupled


class Run:
    """Environments with a solver of their cloths."""

    def __init__(self, name, model):
        self.model = model
        self.solver = couple(model, name)
        self.state, self.next, self.control = model.state(), model.state(), model.control()
        worlds = model.world_count
        self.episodes = episodes = Episodes()
        with wp.ScopedDevice(model.device):
            episodes.time, episodes.number = wp.zeros(worlds, dtype=float), wp.zeros(worlds, dtype=int)
            episodes.resets = wp.full(worlds + 1, False, dtype=wp.bool)
            episodes.ended, episodes.lifted = wp.zeros(1, dtype=int), wp.zeros(1, dtype=int)
        episodes.resets[:worlds].fill_(True)
        self._particles = model.particle_count // worlds
        self._put()
        self._graph = None

    def step(self):
        """Takes a step of all environments, on a GPU from a CUDA graph after the first call."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._step()
        if self.model.device.is_cuda:
            with wp.ScopedCapture(self.model.device) as capture:
                self._step()
            self._graph = capture.graph

    def _step(self):
        self._launch(begin, self.model.world_count, [self.state.particle_q, self._particles, self.episodes])
        self._put()
        for _ in range(DECIMATION * SUBSTEPS):
            self.state.clear_forces()
            self._launch(drive, self.model.world_count, [DT / SUBSTEPS, self.episodes, self.control.joint_target_q])
            self.solver.step(self.state, self.next, self.control, None, DT / SUBSTEPS)
            self.state, self.next = self.next, self.state

    def _put(self):
        model, state = self.model, self.state
        inputs = [model.particle_q, self._particles, self.episodes, state.particle_q, state.particle_qd]
        self._launch(put_cloth, model.particle_count, inputs)
        self._launch(put_gripper, model.joint_dof_count, [self.episodes, state.joint_q, state.joint_qd])
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
        self.solver.reset(state, self.episodes.resets, newton.StateFlags.NONE)

    def _launch(self, kernel, size, inputs):
        wp.launch(kernel, size, inputs=inputs, device=self.model.device)


def measure(name, model, counter, steps):
    """Returns a row: steps of environments a second, crossings, steps not certified, episodes, and how many lifted."""
    run, device = Run(name, model), model.device
    run.step()
    crossings, clock = 0, 0.0
    for _ in range(10):
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(steps // 10):
            run.step()
        wp.synchronize_device(device)
        clock += time.perf_counter() - start
        crossings += counter.count(run.state)
    uncertified = run.solver.report.totals.uncertified_steps if isinstance(run.solver, bsc.SolverCCD) else None
    ended, lifted = (int(array.numpy()[0]) for array in (run.episodes.ended, run.episodes.lifted))
    return model.world_count * 10 * (steps // 10) / clock, crossings, uncertified, ended, lifted


def main():
    """Prints a row for each solver and number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[1, 16], help="on a GPU, 64 to 8192")
    parser.add_argument("--steps", type=int, default=100, help="of the environment, a multiple of 10")
    parser.add_argument("--device", help="Warp device, such as cpu or cuda:0 (default: the first GPU, else cpu)")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--json", metavar="FILE", help="file to which the rows are written as well")
    options = parser.parse_args()
    if options.steps < 10 or options.steps % 10:
        parser.error(f"--steps must be a multiple of 10, not {options.steps}")
    wp.config.log_level = wp.LOG_WARNING
    with wp.ScopedDevice(options.device or wp.get_preferred_device()):
        rows = []
        print(
            f"{'solver':22}{'worlds':>7}{'env-steps/s':>13}{'crossings':>11}{'uncertified':>13}{'episodes':>10}{'lifted':>8}"
        )
        for worlds in options.worlds:
            model = build(worlds)
            counter = CrossingCounter(model)
            for name in options.solvers:
                rate, crossings, uncertified, ended, lifted = measure(name, model, counter, options.steps)
                certified = "-" if uncertified is None else uncertified
                row = f"{name:22}{worlds:>7}{rate:>13.4g}{crossings:>11}{certified:>13}"
                print(f"{row}{ended:>10}{lifted:>8}", flush=True)
                rows.append({"solver": name, "worlds": worlds, "env_steps_per_second": rate, "crossings": crossings})
                rows[-1] |= {"uncertified_steps": uncertified, "episodes": ended, "lifted": lifted}
        if options.json:
            found = {"benchmark": "lift_throughput", "steps": options.steps, "rows": rows}
            write_measurement(options.json, found, [wp.get_device()])


if __name__ == "__main__":
    main()
