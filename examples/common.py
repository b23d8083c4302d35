"""What all examples share: how they run, and in which of Newton's viewers."""

import newton.examples
from newton.viewer import ViewerNull, ViewerViser
from rich.console import Console
from rich.progress import track

ANY_VIEWER = "gl, else viser, else null"


class ViewerProgress(ViewerNull):
    """Shows nothing but how many frames are done."""

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
    """Runs an example as the command line asks, and prints what came of it."""
    viewer, args = open_viewer(example_class.create_parser())
    example = example_class(viewer, args)
    try:
        newton.examples.run(example, args)
    except KeyboardInterrupt:
        if not isinstance(viewer, ViewerViser):  # which has no other end
            raise
    example.print_report()


def open_viewer(parser):
    """Opens the viewer that the command line asks for; without one a window, or what is possible, and says so.

    Args:
        parser: The options, which contain those of ``newton.examples.create_parser``.

    Returns:
        The viewer and the arguments.
    """
    parser.set_defaults(viewer=ANY_VIEWER)
    if parser.parse_args().viewer != ANY_VIEWER:
        return newton.examples.init(parser)
    parser.set_defaults(viewer="gl")
    try:
        return newton.examples.init(parser)
    except Exception as error:  # pyglet, OpenGL or the display is missing, each of which says so in its own way
        missing = f"No window ({' '.join(str(error).split())})"
    parser.set_defaults(viewer="null")
    _, args = newton.examples.init(parser)
    if not (args.test or args.headless):  # which nobody looks at
        try:
            viewer = ViewerViser(host="localhost", paused=args.paused, verbose=False)
        except ImportError:
            missing += ", and no viser for a browser"
        else:
            print(f"{missing}: open {viewer.url} in a browser; Ctrl-C ends the simulation.", flush=True)
            return viewer, args
    print(f"{missing}: simulating {args.num_frames} frames without.", flush=True)
    return ViewerProgress(args.num_frames), args
