"""Base of the examples: options, the collision stage, the loop over frames, the report, and the choice of a viewer."""

import argparse
import functools

import newton.examples
import warp as wp
from newton.viewer import ViewerNull, ViewerViser
from rich.console import Console
from rich.progress import track

import warp_bsc as bsc

ANY_VIEWER = "gl, else viser, else null"


class ExampleBase:
    """A simulation in the format of Newton's examples.

    A derived class calls :meth:`start` at the end of its ``__init__``, and says in ``test_final`` and ``print_report``
    what its scene should have become.

    Attributes:
        num_frames: Default of ``--num-frames``.
        fps: Frames per second.
        sim_substeps: Steps per frame, even, so that a CUDA graph ends with the states that it began with.
    """

    num_frames = 60
    fps = 60
    sim_substeps = 4

    def __init__(self, viewer, args):
        self.viewer = viewer
        self.ccd, self.draws_contacts = args.ccd, args.draw_contacts
        if self.draws_contacts and not self.ccd:
            raise ValueError("--draw-contacts draws what the stage found: omit --no-ccd")
        self.frame_dt = 1.0 / self.fps
        self.sim_dt = self.frame_dt / self.sim_substeps
        self.sim_time = 0.0
        self.frame = 0

    def start(self, model, solver, camera, **options):
        """Puts the collision stage behind a solver, unless ``--no-ccd`` is given, and shows the model.

        Args:
            model: The model.
            solver: The inner solver, which needs no contacts; or a stage, which stays as it is.
            camera: Position [m], pitch and yaw [degrees].
            options: Options of the stage.
        """
        self.model = model
        if self.draws_contacts:
            options["report"] = ["contacts"]
        self.solver = bsc.SolverCCD(solver, **options) if self.ccd and not isinstance(solver, bsc.SolverCCD) else solver
        self.state_0, self.state_1 = model.state(), model.state()
        self.control = model.control()
        self.run_frame = bsc.CapturedSteps(self.simulate, self.solver)
        self.viewer.set_model(model)
        position, pitch, yaw = camera
        self.viewer.set_camera(pos=position, pitch=pitch, yaw=yaw)

    def simulate(self):
        """Simulates a frame."""
        for _ in range(self.sim_substeps):
            self.state_0.clear_forces()
            self.viewer.apply_forces(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, self.sim_dt)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Simulates a frame, on a GPU from a CUDA graph."""
        self.run_frame()
        self.frame += 1
        self.sim_time += self.frame_dt

    def render(self):
        """Shows the frame."""
        self.viewer.begin_frame(self.sim_time)
        self.viewer.log_state(self.state_0)
        self.draw_contacts()
        self.viewer.end_frame()

    def draw_contacts(self):
        """Draws what the stage found and did in the last step, if ``--draw-contacts`` is given."""
        if self.draws_contacts:
            self.solver.report.draw(self.viewer)

    def find_intersections(self):
        """Returns the pairs of an edge and a face that meet in the state, of rigid shapes those with particles.

        Without the stage, only deforming meshes are looked at.
        """
        model, state = self.model, self.state_0
        if not self.ccd:
            mesh = bsc.CollisionMesh(model.tri_indices.numpy(), model.particle_count, device=model.device)
            return bsc.CollisionDetector(mesh).find_intersections(state.particle_q)
        mesh = self.solver.mesh
        positions = wp.empty(mesh.vertex_count, dtype=wp.vec3, device=model.device)
        mesh.positions(state.particle_q, state.body_q, positions)
        pairs = self.detector.find_intersections(positions)
        of_edges, of_faces = (elements.min(axis=1) < model.particle_count for elements in (mesh.edges, mesh.faces))
        return pairs[of_edges[pairs[:, 0]] | of_faces[pairs[:, 1]]]

    @functools.cached_property
    def detector(self):
        """The detector of the mesh of the stage."""
        return bsc.CollisionDetector(self.solver.mesh)

    def test_final(self):
        """Checks that the stage certified all steps, and that nothing crosses in the state."""
        if self.ccd:
            uncertified = self.solver.report.totals.uncertified_steps
            assert uncertified == 0, f"{uncertified} steps are not certified"
            intersections = self.find_intersections()
            assert len(intersections) == 0, f"{len(intersections)} edges cross faces at the end"

    def print_report(self):
        """Prints what the stage did."""
        if self.ccd:
            print(self.solver.report)

    @classmethod
    def create_parser(cls):
        """Returns Newton's options with a number of frames, ``--no-ccd`` and ``--draw-contacts``."""
        parser = newton.examples.create_parser()
        parser.set_defaults(num_frames=cls.num_frames)
        parser.add_argument(
            "--ccd",
            action=argparse.BooleanOptionalAction,
            default=True,
            help="Put the collision stage behind the solver.",
        )
        parser.add_argument(
            "--draw-contacts",
            action="store_true",
            help="Draw normals and impulses of contacts, and vertices that are truncated, frozen or not certified.",
        )
        return parser


class ViewerProgress(ViewerNull):
    """Shows only how many frames are done."""

    def __init__(self, num_frames):
        super().__init__(num_frames=num_frames)
        self._frames = track(range(num_frames), description="Simulating", console=Console(stderr=True))
        next(self._frames, None)

    def end_frame(self):
        """Counts the frame."""
        super().end_frame()
        next(self._frames, None)

    def close(self):
        """Ends the bar."""
        self._frames.close()
        super().close()


def main(example_class):
    """Runs an example with the options of the command line, and prints its report."""
    viewer, args = open_viewer(example_class.create_parser())
    example = example_class(viewer, args)
    try:
        newton.examples.run(example, args)
    except KeyboardInterrupt:
        if not isinstance(viewer, ViewerViser):  # Ctrl-C is the only way to close it
            raise
    example.print_report()


def open_viewer(parser):
    """Opens the viewer of the command line; by default a window, else a browser, else no viewer, and says which.

    Args:
        parser: Options that contain those of ``newton.examples.create_parser``.

    Returns:
        The viewer and the arguments.
    """
    parser.set_defaults(viewer=ANY_VIEWER)
    if parser.parse_args().viewer != ANY_VIEWER:
        return newton.examples.init(parser)
    parser.set_defaults(viewer="gl")
    try:
        return newton.examples.init(parser)
    except Exception as error:  # a missing pyglet, OpenGL or display raises an error of its own type
        missing = f"No window ({' '.join(str(error).split())})"
    parser.set_defaults(viewer="null")
    _, args = newton.examples.init(parser)
    if not (args.test or args.headless):  # nobody looks at those
        try:
            viewer = ViewerViser(host="localhost", paused=args.paused, verbose=False)
        except ImportError:
            missing += ", and no viser for a browser"
        else:
            print(f"{missing}: open {viewer.url} in a browser; Ctrl-C ends the simulation.", flush=True)
            return viewer, args
    print(f"{missing}: simulating {args.num_frames} frames without.", flush=True)
    return ViewerProgress(args.num_frames), args
