"""Films a robot arm that folds the sleeve of a shirt, with VBD and its self-contact, and with SolverImplicit.

    python examples/figures/film_fold.py record recorded --device cuda:0
    python examples/figures/film_fold.py recorded fold.webp

The scene is Newton's example ``cloth_franka``. The first command steps it, and needs neither of the two programs that
the second one needs: Blender as a Python module (``pip install bpy``, Python 3.11) and Pillow.
"""

import argparse
import sys
import time
from pathlib import Path

import newton.examples
import newton.utils
import newton.viewer
import numpy as np
import warp as wp
from newton.examples.cloth.example_cloth_franka import Example
from rich.progress import track

import warp_bsc as bsc
from warp_bsc.bench.crossings import SoftPairs
from warp_bsc.bench.measure.newton_examples import STAGE_TOTALS
from warp_bsc.response.state.mesh import ModelMesh

sys.path.append(str(Path(__file__).parent))  # for the studio
import film

_FRAMES = 984  # to the moment when the arm goes on to the next grip
_EVERY = 12  # frames of the example from one recorded state to the next
_ASSETS = "Folder with franka_emika_panda of newton-assets; default: a download."

_SIZE = 440, 440
_TITLES = {"vbd": "VBD, self-contact on", "implicit": "SolverImplicit"}
_FIRST = 25  # recorded state with which the film begins, before the grip
_EYE, _TARGET, _LENS = (0.75, -1.9, 0.95), (0.10, -0.56, 0.25), 95.0  # m, m, mm
_BACK, _ARM, _FINGERS, _TABLE = "#b9d2ec", "#e4e4e2", "#4a4f57", "#cfc6b8"


class Fold(Example):
    """The example, with a shirt that starts on the table; the example has a third of it in the table."""

    def __init__(self):
        arguments = newton.examples.create_parser().parse_args(["--viewer", "null"])
        super().__init__(newton.viewer.ViewerNull(), arguments)
        positions = self.state_0.particle_q.numpy()
        table = self.table_pos_cm[2] + self.table_hz_cm
        positions[:, 2] += table + self.cloth_particle_radius - positions[:, 2].min()
        self.state_0.particle_q.assign(positions)
        self.prepare()

    def prepare(self):
        """Leaves VBD in place."""

    def capture(self):
        """Waits with the graph for the first step, in which kernels are loaded."""

    def step(self):
        """Steps a frame, on a GPU from the second one on as a CUDA graph."""
        super().step()
        if self.model.device.is_cuda and self.graph is None:
            now = self.sim_time
            super().capture()
            self.sim_time = now

    def totals(self):
        """Returns totals of the steps, by name."""
        return {}


class FoldImplicit(Fold):
    """The example with SolverImplicit in place of VBD."""

    substeps = 4  # of a frame; the example has 10 of VBD
    height = 20.08  # cm, of the lowest point of the fingers: the table is 20 high, and the example's path goes into it
    gap = 0.212  # cm, between the closed fingers; 0.8 in the example, where particles have a radius of 0.8
    margin = 0.05  # cm, that the shirt keeps from the robot

    def create_articulation(self, builder):
        """Adds the robot, whose path stays above the table."""
        super().create_articulation(builder)
        is_tilted, is_closed = np.abs(self.targets[:, 5]) > 0.1, self.targets[:, -1] < 0.5
        self.targets[:, 2] = np.maximum(self.targets[:, 2], self.height + np.where(is_tilted, 0.61, 0.0))
        self.targets[is_closed, -1] = self.gap / 8.0  # each finger moves by four times this

    def prepare(self):
        """Puts the solver in the place of VBD."""
        self.sim_substeps, self.sim_dt = self.substeps, self.frame_dt / self.substeps
        self.model.shape_margin.assign(np.where(self.model.shape_body.numpy() >= 0, self.margin, 0.0))
        self.cloth_solver = bsc.SolverImplicit(
            self.model, bodies="ignored", friction=self.self_contact_friction, min_distance="model", particle_radius=0.0
        )
        self.cloth_solver.rebuild_bvh = lambda state: None  # VBD's, which the example calls

    def totals(self):
        """Returns totals of the steps, by name."""
        totals = self.cloth_solver.report.totals
        return {name: getattr(totals, name) for name in STAGE_TOTALS}


_RUNS = {"vbd": Fold, "implicit": FoldImplicit}


def record(name, folder, frames):
    """Steps a run, writes what is recorded of it to a file, and prints time and crossings."""
    example = _RUNS[name]()
    mesh, particles = ModelMesh(example.model), example.model.particle_count  # shirt, robot and table
    pairs, x = SoftPairs(mesh, particles), wp.empty(mesh.vertex_count, dtype=wp.vec3, device=example.model.device)
    states, bodies, counts, seconds = [], [], [], []
    for frame in track(range(frames + 1), f"Recording {name}"):
        if frame:
            start = time.perf_counter()
            example.step()
            wp.synchronize_device(example.model.device)
            seconds.append(time.perf_counter() - start)
        if frame % _EVERY == 0:
            states.append(example.state_0.particle_q.numpy().copy())
            bodies.append(example.state_0.body_q.numpy().copy())
            mesh.positions(example.state_0.particle_q, example.state_0.body_q, x)
            counts.append(pairs.count_crossings(x))
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(folder / f"{name}.npz", states=states, bodies=bodies, seconds=seconds)
    found, rigid = np.transpose(counts)
    most = {"edges through faces": int((found - rigid).max()), "crossings with robot and table": int(rigid.max())}
    print(name, {"ms a frame": round(1e3 * float(np.mean(seconds[1:])), 1), **most, **example.totals()})


def make(folder, assets=None):
    """Returns the film."""
    use_assets(assets)
    with wp.ScopedDevice("cpu"):
        example = Fold()
    mesh, particles, state = ModelMesh(example.model), example.model.particle_count, example.state_0
    positions = wp.empty(mesh.vertex_count, dtype=wp.vec3, device="cpu")
    runs = {title: dict(np.load(Path(folder) / f"{name}.npz")) for name, title in _TITLES.items()}
    is_shirt = mesh.faces[:, 0] < particles
    shirt, rigid = mesh.faces[is_shirt], mesh.faces[~is_shirt] - particles
    corners = state.particle_q.numpy()[shirt]
    fabric = bsc.CollisionMesh(shirt, particles, device="cpu")
    detector = bsc.CollisionDetector(fabric)
    is_back = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] < 0.0
    body = mesh.shape_vertices.body[rigid[:, 0]]
    is_table = mesh.shape_vertices.shape[rigid[:, 0]] == mesh.shape_vertices.shape.max()
    tints = np.where((body >= body.max() - 1)[:, None], film.linear(_FINGERS), film.linear(_ARM))
    tints[is_table] = film.linear(_TABLE)
    studio = film.Studio(_SIZE, _EYE, _TARGET, lens=_LENS, ground=0.0)
    cloth = studio.add("shirt", shirt, np.where(is_back[:, None], film.linear(_BACK), film.linear(film.BLUE)))
    robot = studio.add("robot", rigid, tints, sheen=0.0, smooth=False)

    def shoot(run, i):
        """Returns the picture of a recorded state, with red dots where edges cross faces, and the number of these."""
        state.particle_q.assign(run["states"][i])
        state.body_q.assign(run["bodies"][i])
        mesh.positions(state.particle_q, state.body_q, positions)
        x = 0.01 * positions.numpy()
        studio.move(cloth, x[:particles])
        studio.move(robot, x[particles:])
        picture = studio.shoot()
        crossing = detector.find_intersections(state.particle_q)[:, 0]
        film.dots(picture, studio.pixels(x[fabric.edges[crossing]].mean(axis=1)), film.RED, 3.0)
        return picture, len(crossing)

    def draw(number):
        i = _FIRST + number
        pictures, counts = zip(*[shoot(run, i) for run in runs.values()], strict=True)
        titles = [f"{title}\n{count} edges through faces" for title, count in zip(runs, counts, strict=True)]
        return film.beside(pictures, titles, f"{i * _EVERY / 60:.1f} s", band=66)

    frames = min(len(run["states"]) for run in runs.values()) - _FIRST
    return film.Film(frames, draw, duration=70, pause=1500)


def use_assets(folder):
    """Takes the robot from a folder with franka_emika_panda of newton-assets, in place of a download."""
    if folder:
        newton.utils.download_asset = lambda name: Path(folder) / name


def main():
    """Reads the command line, and records the runs or renders the film."""
    if sys.argv[1:2] != ["record"]:
        inputs = {"folder": "Folder of the runs, which the command record wrote.", "--assets": _ASSETS}
        film.main(__doc__, make, **inputs)
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=["record"])
    parser.add_argument("folder", type=Path, help="Folder for the runs, one file each.")
    parser.add_argument("--device", help="Device of Warp; default: the first GPU, or the CPU without one.")
    parser.add_argument("--frames", type=int, default=_FRAMES, help=f"Number of frames; default: {_FRAMES}.")
    parser.add_argument("--runs", nargs="+", choices=_RUNS, default=list(_RUNS), help="The runs; default: both.")
    parser.add_argument("--assets", help=_ASSETS)
    arguments = parser.parse_args()
    use_assets(arguments.assets)
    with wp.ScopedDevice(arguments.device):
        for name in arguments.runs:
            record(name, arguments.folder, arguments.frames)


if __name__ == "__main__":
    main()
