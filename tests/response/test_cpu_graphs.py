"""Graphs on the CPU: what is captured does at each replay what it would do without, with the numbers of then."""

import functools
import gc
import os
import signal
import threading
import time
import weakref

import numpy as np
import pytest
import warp as wp
from newton_scenes import DT, SOLVERS, bullet

import warp_bsc as bsc
from warp_bsc.detection.run import host_function
from warp_bsc.detection.run.host_function import run_on_host

CPU = wp.get_device("cpu")


@wp.kernel(enable_backward=False)
def _add_one(x: wp.array[float]):
    wp.atomic_add(x, 0, 1.0)


def captured(function):
    """A graph of what a function launches."""
    with wp.ScopedCapture(CPU) as capture:
        function()
    return capture.graph


def test_a_function_runs_at_each_replay_in_its_place():
    x = wp.zeros(1, dtype=float, device=CPU)
    seen = []

    def add_as_often_as_called():
        seen.append(float(x.numpy()[0]))
        wp.launch(_add_one, len(seen), inputs=[x], device=CPU)

    def launch():
        wp.launch(_add_one, 1, inputs=[x], device=CPU)
        run_on_host(add_as_often_as_called, CPU)
        wp.launch(_add_one, 1, inputs=[x], device=CPU)

    graph = captured(launch)
    assert seen == []
    for _ in range(3):
        wp.capture_launch(graph)
    assert seen == [1.0, 4.0, 8.0]
    assert x.numpy()[0] == 12.0
    launch()
    assert seen[-1] == 13.0


def test_functions_go_with_their_graph():
    class Owner:
        def call(self):
            pass

    before = len(host_function.functions_of_graphs)
    owner = Owner()
    graph = captured(functools.partial(run_on_host, owner.call, CPU))
    reference = weakref.ref(owner)
    del owner
    assert reference() is not None
    del graph
    gc.collect()
    assert reference() is None
    assert len(host_function.functions_of_graphs) == before


def test_an_error_is_raised_where_the_graph_is_launched(capsys):
    called = []

    def fail():
        raise LookupError("nothing there")

    def launch():
        run_on_host(fail, CPU)
        run_on_host(lambda: called.append(1), CPU)

    graph = captured(launch)
    for _ in range(2):
        with pytest.raises(LookupError, match="nothing there"):
            wp.capture_launch(graph)
    assert called == []
    assert "in fail" in capsys.readouterr().err


def test_interrupts_reach_the_program():
    graph = captured(lambda: run_on_host(lambda: time.sleep(30.0), CPU))
    threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    start = time.perf_counter()
    with pytest.raises(KeyboardInterrupt):
        wp.capture_launch(graph)
    assert time.perf_counter() - start < 20.0


def test_graphs_to_be_saved_are_refused():
    with pytest.raises(RuntimeError, match="saved"), wp.ScopedCapture(CPU, apic=True):
        run_on_host(lambda: None, CPU)


FACES = [[0, 1, 2], [3, 4, 5]]
START = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 1], [2, 1, 2], [1, 2, 2]], dtype=np.float32)
END = START - np.float32([0, 0, 4]) * (np.arange(6) >= 3)[:, None]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_detection_reads_the_positions_of_the_replay(dtype):
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=CPU), method="exact")
    vector = wp.vec3 if dtype is np.float32 else wp.vec3d
    x0, x1 = (wp.array(x.astype(dtype), dtype=vector, device=CPU) for x in (START, START))
    with wp.ScopedCapture(CPU) as capture:
        collisions = detector.capture(x0, x1)
    with pytest.raises(RuntimeError, match="not been launched"):
        collisions.read()
    for end, expected in ((START, []), (END, [[3, 0], [4, 0], [5, 0]]), (START, [])):
        x1.assign(end.astype(dtype))
        wp.capture_launch(capture.graph)
        assert collisions.read().vertex_face.tolist() == expected
        assert collisions.read().certified


def test_queues_grow_in_a_replay():
    rng = np.random.default_rng(0)
    faces = rng.permuted(np.tile(np.arange(60), (400, 1)), axis=1)[:, :3]
    detector = bsc.CollisionDetector(bsc.CollisionMesh(faces, 60, device=CPU))
    x0, x1 = (wp.zeros(60, dtype=wp.vec3, device=CPU) for _ in range(2))
    x0.assign(np.arange(60)[:, None] * np.float32([10.0, 1.0, 0.1]))
    x1.assign(x0)
    with wp.ScopedCapture(CPU) as capture:
        collisions = detector.capture(x0, x1)
    start = rng.uniform(-1.0, 1.0, (60, 3)).astype(np.float32)
    end = -start
    x0.assign(start)
    x1.assign(end)
    wp.capture_launch(capture.graph)
    collisions = collisions.read()
    expected = bsc.CollisionDetector(detector.mesh).detect(start, end)
    assert len(expected.edge_edge) > 2 * len(faces)
    np.testing.assert_array_equal(collisions.vertex_face, expected.vertex_face)
    np.testing.assert_array_equal(collisions.edge_edge, expected.edge_edge)
    assert collisions.certified and not collisions.overflowed


def test_a_capture_outside_a_graph_is_refused():
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=CPU))
    x = wp.array(START, dtype=wp.vec3, device=CPU)
    with pytest.raises(RuntimeError, match=r"captures no graph: call capture\(x0, x1\) within wp.ScopedCapture"):
        detector.capture(x, x)


def test_what_returns_arrays_of_the_host_is_refused():
    detector = bsc.CollisionDetector(bsc.CollisionMesh(FACES, 6, device=CPU))
    points = np.zeros((3, 8, 3))
    x = wp.array(START, dtype=wp.vec3, device=CPU, requires_grad=True)
    for call, error in (
        (lambda: detector.find_intersections(x), RuntimeError),
        (lambda: bsc.query_vertex_face(points, device=CPU), RuntimeError),
        (lambda: bsc.query_edge_edge(points, device=CPU), RuntimeError),
        (lambda: detector.detect(x, x), RuntimeError),
        (lambda: detector.capture(x, x), ValueError),
        (lambda: detector.capture(START, END), ValueError),
    ):
        with pytest.raises(error, match="graph"), wp.ScopedCapture(CPU):
            call()


@pytest.mark.parametrize("inner", ["vbd", "xpbd"])
def test_a_step_in_a_graph_is_the_step_without(inner):
    ends = []
    for in_graph in (True, False):
        model = bullet(60.0, device=CPU)
        solver = bsc.SolverCCD(SOLVERS[inner](model))
        states, control = (model.state(), model.state()), model.control()

        def step(solver=solver, states=states, control=control):
            start, end = states
            start.clear_forces()
            solver.step(start, end, control, None, DT)
            start.assign(end)

        if in_graph:
            with wp.ScopedCapture(CPU) as capture:  # before anything touches
                step()
        reports = []
        for _ in range(8):
            if in_graph:
                wp.capture_launch(capture.graph)
            else:
                step()
            reports.append(
                [solver.report.predicted_contacts, solver.report.iterations, solver.report.totals.truncated_steps]
            )
        assert (solver.report.totals.steps, solver.report.totals.uncertified_steps) == (8, 0)
        ends.append([states[0].particle_q.numpy(), states[0].particle_qd.numpy(), reports])
    assert np.max(reports, axis=0)[1] > 1
    for actual, expected in zip(*ends, strict=True):
        np.testing.assert_array_equal(actual, expected)
