from collections.abc import Callable, Iterable, Iterator, Sequence
from os import PathLike
from typing import Any, Literal, Optional, Union, overload

import numpy as np
from numpy.typing import NDArray

from . import aio as aio
from ._errors import Disconnected as Disconnected
from ._errors import Error as Error
from ._errors import Failed as Failed
from ._errors import Refused as Refused
from ._fit import Curve as Curve
from ._fit import Fit as Fit
from ._journal import Commands as Commands
from ._journal import Course as _ToolCourse
from ._journal import Verdict as Verdict
from ._run import Run as Run
from ._touch import Course as Course
from ._touch import Frame as Frame
from ._touch import Sampled as Sampled
from ._touch import ToolState as ToolState
from ._touch import Touched as Touched
from ._touch import press as press

__version__: str

Source = Union[str, PathLike[str]]
Vector = Union[tuple[float, float, float], list[float], NDArray[np.float64]]
Point = Union[tuple[int, int], list[int], int]
Settings = Union[dict[str, Any], list[str]]
Vectors = NDArray[np.float64]

class Scene:
    """A scene that was read and checked: from TOML text, a file, or a scene's name (`scenes()`).

    `set` overrides keys: {"springs.stiffness_n_per_m": 50}. `folder` contains the scenes that are given by name. With `plan`
    the scene is stepped like that tissue (integrator, substeps, precision, sleep), without the search for what its own
    tolerance requires: that saves most of the time of a short run, but its error is unknown (`run(..., audit=True)` measures
    it).
    """

    def __init__(
        self,
        source: Source,
        *,
        set: Optional[Settings] = None,
        folder: Source = "scenes",
        plan: Optional[Tissue] = None,
    ) -> None: ...
    @property
    def name(self) -> str:
        """The scene's name."""
    @property
    def points(self) -> int:
        """The number of mass points."""
    @property
    def rate_hz(self) -> float:
        """Number of steps per second."""

class Script:
    """Forces and movements over time: from TOML text, a file, or a script's name (`scripts()`). `folder` contains the traces
    that a text names."""

    def __init__(self, source: Source, *, folder: Source = "") -> None: ...
    def check(self, scene: Union[Scene, Source]) -> dict[str, Any]:
        """Binds the script to a scene; returns its name, steps, sample_every_steps, tools and warnings. Raises Refused if it
        does not fit."""

class Tissue:
    """A compiled scene: what is simulated, and how. Compiling may take some tenths of a second; a Scene does it once."""

    def __init__(self, scene: Union[Scene, Source]) -> None: ...
    def __len__(self) -> int: ...
    @property
    def name(self) -> str:
        """The name of its scene."""
    @property
    def rate_hz(self) -> float:
        """Number of steps per second."""
    @property
    def integrator(self) -> str:
        """The integrator with which it is stepped."""
    @property
    def substeps(self) -> int:
        """Number of substeps per step."""
    @property
    def precision(self) -> str:
        """The number format of the points."""
    @property
    def lanes(self) -> str:
        """The vector instructions with which it is stepped. They do not change the results."""
    @property
    def expected_error(self) -> float:
        """The expected error of displacement and force, relative to the largest of each; infinite if it is unknown."""
    @property
    def warnings(self) -> list[str]:
        """Warnings about the scene, as sentences."""
    @property
    def grid(self) -> Optional[tuple[int, int]]:
        """Number of points along x and y of a sheet, as in rest_m.reshape(*grid, 3); None for a mesh."""
    @property
    def rest_m(self) -> Vectors:
        """The position of each point at rest, m."""
    @property
    def normals(self) -> Vectors:
        """The outward unit normal of the surface at rest at each point."""
    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Whether each point is fixed."""
    @property
    def mass_kg(self) -> NDArray[np.float64]:
        """The mass of each point, kg."""
    @property
    def triangles(self) -> NDArray[np.uint32]:
        """The triangles of the surface, each with the rows of its three points, counter-clockwise from outside."""
    @property
    def middle_m(self) -> tuple[float, float, float]:
        """The middle of the bounding box of the tissue at rest, m."""
    @property
    def top_m(self) -> tuple[float, float, float]:
        """The highest place of the surface at rest above or below the middle, m: of a sheet, its middle. Devices have their
        origin there."""
    def index(self, point: Point) -> int:
        """Returns the row of a point: (i, j) on a sheet, the number of a vertex on a mesh."""
    def point(self, index: int) -> Union[tuple[int, int], int]:
        """Returns the name of the point in a row."""
    def nearest(self, place_m: Vector) -> int:
        """Returns the row of the point that rests nearest to a place."""

class Tip:
    """The tip of a tool: a disc that touches, or holds with `grasps=True`. With a stiffness it is coupled by a spring. With
    `shape="rigid"` it is a flat rigid disc, with `shape="sphere"` a rigid sphere, whose place is its centre: on solids only. With
    `edge_m` it is a blade, whose edge runs from its place by that vector. With
    `burn_s`, s, a tip that is no blade severs by heat what it has touched for that time."""

    def __init__(
        self,
        radius_m: float = 0.005,
        *,
        friction: float = 0.2,
        grasps: bool = False,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: float = 0.0,
        shape: str = "disc",
        edge_m: Optional[Vector] = None,
        burn_s: float = 0.0,
    ) -> None: ...
    @property
    def shape(self) -> str:
        """The shape: disc, rigid, sphere or blade."""
    @property
    def radius_m(self) -> float:
        """The radius of the disc or sphere, m."""
    @property
    def friction(self) -> float:
        """The coefficient of friction."""
    @property
    def grasps(self) -> bool:
        """Whether the tip holds the tissue under it instead of touching it."""

class Instrument:
    """An instrument that a device leads by its place and orientation: jaws that end at its place, and a shaft behind them, each
    a row of tips of a length. It points along x of its frame; the jaws open in y. With `port_m` the shaft slides through that
    place, as through a trocar, and the handle is `handle_m` from the place. `Touched.jaw_overloads` counts how often the torque
    between the jaws exceeded `jaw_torque_limit_n_m`. Raises Refused if it has neither jaws nor a shaft."""

    def __init__(
        self,
        *,
        jaws_m: Optional[float] = None,
        shaft_m: Optional[float] = None,
        tip: Optional[Tip] = None,
        port_m: Optional[Vector] = None,
        handle_m: float = 0.33,
        jaw_torque_limit_n_m: Optional[float] = None,
    ) -> None: ...
    @property
    def tips(self) -> int:
        """The number of tips: each is a tool of the session."""

class Hand:
    """One of the two hands of a program, from `two_hands`."""

class Session:
    """A simulated tissue. A tool's command acts from the next step on, until its next command. Several threads may use one
    session; the interpreter's lock is released while it steps."""

    def __init__(self, tissue: Union[Tissue, Scene, Source]) -> None: ...
    @staticmethod
    def restore(scene: Union[Scene, Tissue, Source], snapshot: bytes) -> Session:
        """Restores a session from `save()` that started with `scene`: tools stay where they are, with their tips."""
    def step(self, steps: int = 1) -> None:
        """Does `steps` steps. Raises Failed if the tissue can't continue. Ctrl-C ends it between two steps."""
    @property
    def steps(self) -> int:
        """Number of steps done."""
    @property
    def time_s(self) -> float:
        """Simulated time, s."""
    @property
    def tissue(self) -> Tissue:
        """The tissue, with its current coefficients."""
    @property
    def awake_points(self) -> int:
        """Number of points that the last step computed; the others are at rest."""
    @property
    def guard_events(self) -> int:
        """How often the guard went back to a checkpoint and halved the substep, or brought a solid that rested inside out to its
        shape."""
    @property
    def severed(self) -> int:
        """The number of springs that blades have severed."""
    @property
    def pieces(self) -> int:
        """The number of parts of the tissue: 1 if it is whole."""
    @property
    def fracture_j(self) -> float:
        """The energy that has gone into separation, J: the work of blades at their edges, and what severed springs had stored."""
    @property
    def fault(self) -> Optional[str]:
        """Why the tissue is not in the state that its tools caused, as a sentence: it is stopped, or has recovered. None if
        it is."""
    @property
    def hash(self) -> str:
        """The hash of the state: equal for equal bits."""
    def push(
        self,
        tool: int,
        force_n: Vector,
        *,
        point: Optional[Point] = None,
        at_m: Optional[Vector] = None,
        falloff_per_m: float = 200.0,
        falloff_offset: float = 0.0,
    ) -> None:
        """Pushes at a point or a place; at a distance r from there with force_n * exp(-falloff_per_m * r + falloff_offset)."""
    def grasp(self, tool: int, point: Point, displacement_m: Vector) -> None:
        """Holds a point, and moves it to this displacement from its place at rest by the end of the step."""
    def pose(self, tool: int, place_m: Vector, tip: Optional[Tip] = None) -> None:
        """Moves a tool with a tip to `place_m` by the end of the step. It stays there until its next command."""
    def thread(
        self,
        tool: int,
        number: int,
        bites_m: Sequence[Vector],
        length_m: float,
        *,
        radius_m: float = 0.001,
        friction: float = 0.0,
        strength_n: Optional[float] = None,
    ) -> None:
        """Lays thread `number` through bites at these places of the tissue at rest, in their order, or changes its length, friction or
        strength if it has these bites already. It has `length_m` from the first bite to the last, is drawn in at the last by at most
        0.1 m/s, and breaks beyond a tension of `strength_n`. It stays when the tool, which does what it did, is released."""
    def clip(
        self,
        tool: int,
        number: int,
        bites_m: Sequence[Vector],
        *,
        radius_m: float = 0.001,
        strength_n: Optional[float] = None,
    ) -> None:
        """Closes clip `number` on two places of the tissue at rest, and holds them together; it opens beyond a force of `strength_n`.
        Threads and clips share their numbers. It stays when the tool, which does what it did, is released."""
    def mark(self, tool: int, place_m: Vector, *, diameter_m: Optional[float] = None) -> None:
        """Marks a place of the surface, m, as an answer in an exercise: what you look for is there, or below it, and has about this
        diameter, m. It changes nothing, and the tool does what it did."""
    def untie(self, tool: int, number: int) -> None:
        """Cuts a thread or clip, and takes it out."""
    @property
    def ties(self) -> dict[int, dict[str, Any]]:
        """The threads and clips by their number, those that broke included: a dictionary for each, with `tensions_n` between successive
        bites in the last step, the largest so far, `peak_n`, the thread's `length_m`, `path_m`, the distances between its bites in all,
        and `is_broken`."""
    def release(self, tool: int) -> None:
        """Ends what a tool does."""
    def tool(self, tool: int) -> Optional[ToolState]:
        """Returns what a tool does and feels; None if it does nothing."""
    def change(
        self,
        *,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: Optional[float] = None,
        anchor_stiffness_n_per_m: Optional[float] = None,
        volume_stiffness_pa: Optional[float] = None,
    ) -> None:
        """Makes the tissue softer or stiffer from the next step on. Coefficients that are not given stay as they are."""
    def displacements(self, out: Optional[Vectors] = None) -> Vectors:
        """Returns the displacement of each point from its place at rest, m, with at least the digits of f32; `records` has
        all digits. `out` is an array to write into."""
    def positions(self, out: Optional[Vectors] = None) -> Vectors:
        """Returns the position of each point, m. `out` is an array to write into."""
    def velocities(self, out: Optional[Vectors] = None) -> Vectors:
        """Returns the velocity of each point, m/s. `out` is an array to write into."""
    def burns(self) -> NDArray[np.float64]:
        """Returns how burnt each point is by cautery: the time of contact divided by that in which it burns through, 0 to 1.
        In a solid that of the most burnt cell around the point."""
    def records(self, points: Optional[Iterable[Point]] = None) -> NDArray[Any]:
        """Returns records of all quantities of the given points, as in `Run.points`; of all points if None."""
    @property
    def energy_j(self) -> dict[str, float]:
        """The energy of the tissue, J: kinetic, spring and virtual."""
    def save(self) -> bytes:
        """Returns a snapshot, for `restore`."""

class Journal:
    """A recorded session: a journal file of `palpate serve --journal`."""

    def __init__(self, path: Source) -> None: ...
    @property
    def info(self) -> dict[str, Any]:
        """Information on the recording, by name: scene, first and last step, and more."""
    def tools(self) -> dict[int, _ToolCourse]:
        """Returns what each tool did and felt, by its number."""
    def commands(self) -> Commands:
        """Returns all commands, by the step at which they acted."""
    def verify(self) -> Verdict:
        """Simulates the recording again, and compares every hash and snapshot. Returns the verdict."""
    def session(self, step: Optional[int] = None) -> Session:
        """Returns the session after `step` steps; at the end of the recording if None."""

class Offline:
    """A touch loop without a network: equal messages, places and times give equal forces, bit by bit, as in every other
    language.

    `limits` are the limits of a device, as for a Course. Places are measured from the middle of the device's workspace, which
    is placed at `middle_m` of the tissue (use its `top_m`, as a server does); with `in_tissue_frame`, in the tissue's own
    frame.
    """

    def __init__(
        self,
        limits: Union[str, dict[str, float], None] = None,
        *,
        middle_m: Optional[Vector] = None,
        in_tissue_frame: bool = False,
        up_deadband: float = 0.0,
    ) -> None: ...
    def arrive(self, message: bytes) -> None:
        """Delivers a message of the server: the bytes of a `palpate.v1.TouchResponse`. The next tick uses it."""
    def tick(self, place_m: Vector, time_s: float, enable: bool = True) -> tuple[float, float, float]:
        """Returns the force to render from now on, N, for a device that is at `place_m` at `time_s`, a time of any origin. A
        change of enable from False to True enables forces. Without a connection (an `opened` message that has arrived) the
        force is zero."""
    def disable(self) -> None:
        """Stops rendering until it is enabled again."""
    @property
    def state(self) -> Literal["waiting", "disabled", "enabled", "paused", "fault"]:
        """Whether forces are rendered: "waiting" before a connection, "disabled" until forces are enabled, "enabled",
        "paused" after a silence, "fault" after a position that is not finite or outside the workspace."""
    @property
    def place_m(self) -> tuple[float, float, float]:
        """The tool's position at the last tick, in the tissue's frame."""
    @property
    def age_s(self) -> Optional[float]:
        """Age of the newest data of the tissue, s; None before the first."""

class Samples(Iterator[dict[str, Any]]):
    """The samples of a session, one after another: what tools feel. Each is a dictionary:

    - `step`: steps done; `time_s`: simulated time.
    - `awake_points`: points that the step computed; `asleep`: nothing moves; `held`: the guard has stopped the session.
    - `overruns`: steps that were due and dropped; `time_dilation`: simulated over real time; `late_commands`: commands that
      arrived too late for their step; `dropped_samples`: samples that were dropped because this reader was too slow. Counts
      are since the session started.
    - `tools`: each active tool, by its number, as a dictionary. `displacement_m`: displacement of the tissue under the tool
      from its place at rest, under a tip the mean over its disc; `surface_displacement_m`: displacement of the surface just
      under the tool's centre; `velocity_m_per_s`; `force_on_tool_n`: the force of the tissue on the tool; `applied_force_n`:
      the force of all tools on the tissue there; all in the tissue's frame. `late`: its newest command arrived too late;
      `expired`: its action has ended by itself; `stale`: no pose arrived for 50 ms.
    """

    def take(self, count: int) -> Sampled:
        """Returns the next `count` samples as arrays; fewer at the end of the stream."""
    def __next__(self) -> dict[str, Any]: ...

class Frames(Iterator[Frame]):
    """The frames of a session, one after another: the moving surface."""

    def __next__(self) -> Frame: ...

class Measures(Iterator[dict[str, Any]]):
    """The measures of a session's exercise, one moment after another, ten per second of simulated time. Each is a dictionary:

    - `step`: steps done; `time_s`: simulated time since the exercise began.
    - `figures`: the figures of all tools together, by the name of the measure; `tools`: those of each tool, by its number.
    - `score_percent`: the score if it ended now; None for a trainee.
    - `advice`: what the trainer has told since the moment before: `number`, `text`, `place_m` of a marker.
    - `phase`: the phase that goes on, from 1, None for an exercise of one piece; `phase_time_s`: simulated time since it began.
    - `result`: what `RemoteSession.finish_exercise` returns, once the exercise has ended; the iteration ends then.
    """

    def __next__(self) -> dict[str, Any]: ...

class RemoteSession:
    """A session on a server. `with` deletes it at the end. In a fleet, calls and streams follow it to the server that has it.
    """

    @property
    def id(self) -> str:
        """The id of the session, for `Client.session`."""
    @property
    def server(self) -> str:
        """URL of the server that last had the session."""
    def status(self) -> dict[str, Any]:
        """Returns the state of the session: state, step, points, held tools, what is cut, threads and clips, and more."""
    def start(self, *, until_step: Optional[int] = None) -> int:
        """Starts the session, to run until step `until_step` if given. Returns the next step."""
    def pause(self) -> None:
        """Pauses the session after its current step."""
    def change(
        self,
        *,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: Optional[float] = None,
        anchor_stiffness_n_per_m: Optional[float] = None,
        volume_stiffness_pa: Optional[float] = None,
        at_step: Optional[int] = None,
    ) -> int:
        """Makes the tissue softer or stiffer, from step `at_step` on if given, else from the next. Returns that step.
        Coefficients that are not given stay as they are."""
    def hash(self, *, at_step: Optional[int] = None) -> tuple[int, str]:
        """Returns a number of steps done and the hash of the state after them: `at_step` if given, else the current one."""
    def save(self) -> bytes:
        """Returns a journal of the current moment (MCAP), for `Journal`."""
    def delete(self) -> None:
        """Deletes the session, for all its users."""
    def samples(self, *, every_steps: int = 1, heartbeat_s: Optional[float] = None) -> Samples:
        """Watches the samples of all tools from now on, one per `every_steps` steps. `heartbeat_s` is the longest time
        between two samples of a tissue at rest, s."""
    def frames(self, *, rate_hz: float = 60.0, refinement: int = 0, precise: bool = True) -> Frames:
        """Watches the surface from now on, at most `rate_hz` frames per second. `refinement` is the number of vertices
        between two points of the tissue, 0 to 10; `precise=False` halves the bytes."""
    def mesh(self, *, refinement: int = 0) -> dict[str, Any]:
        """Returns the constant part of the surface: grid, rest_m, uv, triangles, file_vertex."""
    def touch(
        self,
        device: Any,
        *,
        seconds: Optional[float] = None,
        tool: int = 0,
        tip: Optional[Tip] = None,
        deadband: float = 0.0,
        up_deadband: float = 0.0,
        datagrams: bool = True,
        prediction: Literal["auto", "always", "never"] = "auto",
        holder: str = "python",
        remember: bool = True,
        instrument: Optional[Instrument] = None,
        hand: Optional[Hand] = None,
    ) -> Touched:
        """Touches with a device at 1 kHz, on a thread of its own, with rendered forces within the safety envelope.

        `device` is a Course, or an object with `read()`, which returns ((x, y, z), enable), and `write(force_n)`, and
        optionally `limits`, as a Course has them. A change of enable from False to True enables forces. `prediction` says of
        which tissues the loop simulates a copy, so that forces come without the delay of the network: "auto", of meshes;
        "always"; "never". Warns (RuntimeWarning) if no force was felt at all. Raises Refused, reason TOOL_HELD, if somebody
        holds the tool, this session object included.

        With `instrument` the device leads it, and its tips are the tools from `tool` on: `read()` also returns the
        orientation (w, x, y, z) of the device and the angle between the jaws, rad, and `write(force_n, torque_n_m)` gets the
        torque about the device's place, within `torque_n_m` of `limits`. Force and torque come from a copy of the tissue.

        With `hand`, one of `two_hands`, another call touches the same session with the other hand, and each copy of the tissue
        has the tools of both at once. `prediction` must allow a copy: "always" for single tips on a sheet.
        """
    def pose(self, tool: int, place_m: Vector, tip: Optional[Tip] = None) -> None:
        """Moves a tool with a tip to `place_m` by the end of the next step; acquires the tool first if needed. It stays there
        until its next command, even if the session moves. Raises Refused, reason TOOL_HELD, if somebody else holds the tool.
        """
    def push(
        self,
        tool: int,
        force_n: Vector,
        *,
        point: Optional[Point] = None,
        at_m: Optional[Vector] = None,
        falloff_per_m: float = 200.0,
        falloff_offset: float = 0.0,
    ) -> None:
        """Pushes at a point or a place; at a distance r from there with force_n * exp(-falloff_per_m * r + falloff_offset)."""
    def grasp(self, tool: int, point: Point, displacement_m: Vector) -> None:
        """Holds a point, and moves it to this displacement from its place at rest."""
    def thread(
        self,
        tool: int,
        number: int,
        bites_m: Sequence[Vector],
        length_m: float,
        *,
        radius_m: float = 0.001,
        friction: float = 0.0,
        strength_n: Optional[float] = None,
    ) -> None:
        """Lays thread `number`, as `Session.thread` does; acquires the tool first if needed. `status()["ties"]` has the threads and
        clips."""
    def clip(
        self,
        tool: int,
        number: int,
        bites_m: Sequence[Vector],
        *,
        radius_m: float = 0.001,
        strength_n: Optional[float] = None,
    ) -> None:
        """Closes clip `number` on two places, as `Session.clip` does; acquires the tool first if needed."""
    def mark(self, tool: int, place_m: Vector, *, diameter_m: Optional[float] = None) -> None:
        """Marks a place of the surface, m, as `Session.mark` does; acquires the tool first if needed."""
    def exercise(self) -> Optional[dict[str, Any]]:
        """Returns the exercise that the session is made for: `exercise` (like `Client.exercises`), `role` ("trainer" or "trainee"),
        `begin_step`, `finished`, and for a trainer `trainee_id` and `seed`; None for any other session."""
    def measures(self) -> Measures:
        """Watches the measures of the session's exercise from now on, until it ends."""
    def finish_exercise(self) -> dict[str, Any]:
        """Ends the session's exercise, unless it has ended, and returns its result: `figures`, `tools`, `score_percent`, `criteria`, the
        hidden `lumps`, the `answers`, the `phases` (each with `begin_step`, `step`, `time_s`, `figures` and `tools`), `step` and `time_s`. A
        trainee gets step and time alone if the exercise says so (`is_told`)."""
    def finish_phase(self, phase: int) -> Optional[dict[str, Any]]:
        """Ends a phase of the session's exercise, from 1, unless it has ended, so that the next one begins. Returns None, or with the last
        phase what `finish_exercise` returns."""
    def advise(self, text: str = "", *, place_m: Optional[Vector] = None) -> None:
        """Sends the trainee a hint (a text), or a marker at a place of the surface at rest, m. For trainers."""
    def hide_lump(
        self,
        *,
        centre_m: Optional[Vector] = None,
        radius_m: Optional[float] = None,
        stiffness_factor: Optional[float] = None,
    ) -> dict[str, Any]:
        """Hides another lump in the tissue while the exercise goes on: drawn as the exercise draws its lumps, or the given one
        (`centre_m` and `radius_m`, m, and `stiffness_factor`, all three). Returns these of the lump, and the `step` from which on it is
        there. For trainers."""
    def untie(self, tool: int, number: int) -> None:
        """Cuts a thread or clip, and takes it out; acquires the tool first if needed."""
    def release(self, tool: int) -> None:
        """Ends what a tool does, and releases it."""
    def play(self, script: Union[Script, Source], *, scene: Optional[Union[Scene, Source]] = None) -> Run:
        """Plays a script in real time, each command at its exact step, starting at the session's current step. The session
        must be paused, and is paused at the end. If it starts at step 0, the records are those of `run(..., held=True)`. A
        session on a mesh needs its `scene`, unless you created it from one."""
    def __enter__(self) -> RemoteSession: ...
    def __exit__(self, *raised: object) -> None: ...

class Client:
    """A connection to a server."""

    def scenes(self) -> list[str]:
        """Returns the names of the server's scenes."""
    def sessions(self) -> list[dict[str, Any]]:
        """Returns the state of each session of the server, like `RemoteSession.status`."""
    def create_session(
        self, scene: Union[str, Scene], *, paused: bool = False, idle_timeout_s: Optional[float] = None
    ) -> RemoteSession:
        """Creates a session of one of the server's scenes, by its name, or of a scene of yours. The server deletes it when
        nobody uses it for `idle_timeout_s`."""
    def exercises(self) -> list[dict[str, Any]]:
        """Returns the server's exercises: name, title, instructions, scenes, limits, and what a trainee is told."""
    def create_exercise(
        self,
        exercise: str,
        *,
        seed: Optional[int] = None,
        scene: Optional[str] = None,
        paused: bool = False,
        idle_timeout_s: Optional[float] = None,
    ) -> RemoteSession:
        """Creates a session for an exercise, by its name, or for one of yours, by its text (TOML). Without a seed, the server draws the
        hidden truth from one that it does not tell trainees. The session is the trainer's; `exercise()["trainee_id"]` is the id for
        `session` that opens it for a trainee."""
    def load(
        self, plan: Union[Source, dict[str, Any]], *, report: Optional[Union[str, PathLike[str]]] = None
    ) -> dict[str, Any]:
        """Loads the server with simulated users by a plan, like `palpate-client load --plan`, and returns the report. `plan`
        is a file (TOML), its text, or a dict with its keys. `report` is a file for a page with plots (HTML). "kept" of the
        report says whether all objectives were met and no stream broke, "why" lists what was not; see docs/operating.md.
        Ctrl-C ends it, and deletes its sessions."""
    def session(self, session_id: str) -> RemoteSession:
        """Returns the session with this id. Raises Refused if there is none."""

def connect(
    url: str,
    *,
    token: Optional[str] = None,
    ca: Optional[str] = None,
    tls_name: Optional[str] = None,
    cert: Optional[str] = None,
    key: Optional[str] = None,
    within_s: float = 10.0,
) -> Client: ...
def load(
    plan: Union[Source, dict[str, Any]],
    server: Union[str, Client] = "http://127.0.0.1:7117",
    *,
    report: Optional[Union[str, PathLike[str]]] = None,
) -> dict[str, Any]: ...
def fit(
    scene: Union[Scene, Tissue, Source],
    curves: Union[Curve, Sequence[Curve], Source],
    *,
    parameters: Optional[Sequence[str]] = None,
    threads: Optional[int] = None,
) -> Fit:
    """Fits parameters of a scene to measured curves of force over depth, as `palpate fit` does: `curves` are one or several
    `Curve`, or the path of a table. `parameters` are keys of the scene such as "material.youngs_modulus_pa"; by default all
    that the scene has and the curves can tell. Raises Refused if the curves can't tell one that is named."""

def run(
    scene: Union[Scene, Tissue, Source], script: Union[Script, Source], *, held: bool = False, audit: bool = False
) -> Run:
    """Plays a script, with the numbers and the hash of `palpate run`. `held=True` holds forces constant within each step, as
    a client does; `audit=True` plays it a second time in f64 with a quarter of the substep, and reports the difference
    (summary["audited_error"])."""

@overload
def study(
    cases: Iterable[tuple[Union[Scene, Tissue, Source], Union[Script, Source]]],
    *,
    held: bool = False,
    threads: Optional[int] = None,
    errors: Literal["raise"] = "raise",
    progress: Optional[Callable[[int, int], object]] = None,
) -> list[Run]: ...
@overload
def study(
    cases: Iterable[tuple[Union[Scene, Tissue, Source], Union[Script, Source]]],
    *,
    held: bool = False,
    threads: Optional[int] = None,
    errors: Literal["return"],
    progress: Optional[Callable[[int, int], object]] = None,
) -> list[Union[Run, Exception]]:
    """Runs many cases (scene, script) on several threads, and returns the results in their order; by default on as many
    threads as there are processors. `progress` is called with the number of cases done and of all cases."""

def scenes(folder: Source = "scenes") -> list[str]:
    """Returns the names of the built-in scenes, and of those in a folder."""
def scripts(folder: Source = "scripts") -> list[str]:
    """Returns the names of the built-in scripts, and of those in a folder."""
def two_hands() -> tuple[Hand, Hand]:
    """Returns the two hands of a program, for `hand` of two calls of `RemoteSession.touch` in one session, at the same time: on two
    threads, or with asyncio. Each copy of the tissue then has the tools of the other hand at once, without the delay of the
    network. Each hand serves one call."""

def devices() -> list[str]:
    """Returns the names of the devices whose limits are known."""
