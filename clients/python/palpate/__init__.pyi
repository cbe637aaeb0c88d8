from collections.abc import Callable, Iterable, Iterator
from os import PathLike
from typing import Any, Literal, Optional, Union, overload

import numpy as np
from numpy.typing import NDArray

from . import aio as aio
from ._errors import Disconnected as Disconnected
from ._errors import Error as Error
from ._errors import Failed as Failed
from ._errors import Refused as Refused
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
    """A scene that was read and checked: from TOML text, a file, or the name of one (`scenes()`).

    `set` overrides keys: {"springs.stiffness_n_per_m": 50}. `folder` is where scenes are that are given by name. With `plan` it is
    stepped as that tissue is (integrator, substeps, precision, sleep), without the search for what its own tolerance asks for: that
    saves most of the time of a short run, and nothing is then known of the error (`run(..., audit=True)` measures it).
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
        """Its name."""
    @property
    def points(self) -> int:
        """The number of its points."""
    @property
    def rate_hz(self) -> float:
        """Steps a second."""

class Script:
    """Forces and movements over time: from TOML text, a file, or a name (`scripts()`). `folder` is where a text's traces are."""

    def __init__(self, source: Source, *, folder: Source = "") -> None: ...
    def check(self, scene: Union[Scene, Source]) -> dict[str, Any]:
        """Binds it to a scene: name, steps, sample_every_steps, tools, warnings. Raises Refused if it does not fit."""

class Tissue:
    """A compiled scene: what is simulated, and how. Making one may take some tenths of a second, and a Scene does it once."""

    def __init__(self, scene: Union[Scene, Source]) -> None: ...
    def __len__(self) -> int: ...
    @property
    def name(self) -> str:
        """The name of its scene."""
    @property
    def rate_hz(self) -> float:
        """Steps a second."""
    @property
    def integrator(self) -> str:
        """The integrator that it is stepped with."""
    @property
    def substeps(self) -> int:
        """Substeps of each step."""
    @property
    def precision(self) -> str:
        """The number format of the points."""
    @property
    def lanes(self) -> str:
        """The vectors of the machine that it is stepped with. They change no bit."""
    @property
    def expected_error(self) -> float:
        """The error that is expected of displacement and force, relative to the largest of each; infinite if nothing is
        known of it."""
    @property
    def warnings(self) -> list[str]:
        """What a user should know of the scene, in words."""
    @property
    def grid(self) -> Optional[tuple[int, int]]:
        """Points along x and y of a sheet: rest_m.reshape(*grid, 3); None of a mesh."""
    @property
    def rest_m(self) -> Vectors:
        """Where each point rests."""
    @property
    def normals(self) -> Vectors:
        """The normal of the surface at rest at each point, out of the tissue."""
    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Whether each point is fixed."""
    @property
    def mass_kg(self) -> NDArray[np.float64]:
        """The mass of each point."""
    @property
    def triangles(self) -> NDArray[np.uint32]:
        """The triangles of the surface, each the rows of its three points, counter-clockwise from outside."""
    @property
    def middle_m(self) -> tuple[float, float, float]:
        """The middle of the box around the tissue at rest."""
    @property
    def top_m(self) -> tuple[float, float, float]:
        """The highest place of the surface at rest in line with the middle: of a sheet, its middle. Devices have their origin
        there."""
    def index(self, point: Point) -> int:
        """The row of a point: (i, j) of a sheet, the number of a vertex of a mesh."""
    def point(self, index: int) -> Union[tuple[int, int], int]:
        """The name of the point of a row."""
    def nearest(self, place_m: Vector) -> int:
        """The row of the point that rests nearest to a place."""

class Tip:
    """The tip of a tool: a disc that touches, or with `grasps` holds. With a stiffness it is coupled by a spring."""

    def __init__(
        self,
        radius_m: float = 0.005,
        *,
        friction: float = 0.2,
        grasps: bool = False,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: float = 0.0,
    ) -> None: ...
    @property
    def radius_m(self) -> float:
        """The radius of the disc."""
    @property
    def friction(self) -> float:
        """The coefficient of friction."""
    @property
    def grasps(self) -> bool:
        """Whether it holds the tissue under it, in place of touching it."""

class Session:
    """A tissue in use. What tools are told acts from the next step on, until they are told something else. Several threads may use
    one session; the interpreter's lock is free while it steps."""

    def __init__(self, tissue: Union[Tissue, Scene, Source]) -> None: ...
    @staticmethod
    def restore(scene: Union[Scene, Tissue, Source], snapshot: bytes) -> Session:
        """Goes on from `save()`, of a session that began with `scene`: tools stay where they are, with their tips."""
    def step(self, steps: int = 1) -> None:
        """Does so many steps. Raises Failed if the tissue can't go on. Ctrl-C ends it between two steps."""
    @property
    def steps(self) -> int:
        """Steps so far."""
    @property
    def time_s(self) -> float:
        """Simulated time so far."""
    @property
    def tissue(self) -> Tissue:
        """The tissue, with the coefficients that it has now."""
    @property
    def awake_points(self) -> int:
        """Points that the last step computed; the others are at rest."""
    @property
    def guard_events(self) -> int:
        """How often the guard went back and halved the substep."""
    @property
    def fault(self) -> Optional[str]:
        """Why the tissue is not what its tools made of it, in words: it is held, or has recovered. None if it is."""
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
        """Pushes at a point or a place; at a distance r from there by force_n * exp(-falloff_per_m * r + falloff_offset)."""
    def grasp(self, tool: int, point: Point, displacement_m: Vector) -> None:
        """Holds a point, and brings it this far from where it rests by the end of the step."""
    def pose(self, tool: int, place_m: Vector, tip: Optional[Tip] = None) -> None:
        """Brings a tool with a tip here by the end of the step. It stays here until it is told something else."""
    def release(self, tool: int) -> None:
        """Ends what a tool does."""
    def tool(self, tool: int) -> Optional[ToolState]:
        """What a tool does and feels; None if it does nothing."""
    def change(
        self,
        *,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: Optional[float] = None,
        anchor_stiffness_n_per_m: Optional[float] = None,
        volume_stiffness_pa: Optional[float] = None,
    ) -> None:
        """Makes the tissue softer or stiffer from the next step on. What is not named stays as it is."""
    def displacements(self, out: Optional[Vectors] = None) -> Vectors:
        """How far each point is from where it rests, with the digits of f32 at least; `records` has them all. `out` is an array to
        write into."""
    def positions(self, out: Optional[Vectors] = None) -> Vectors:
        """Where each point is. `out` is an array to write into."""
    def velocities(self, out: Optional[Vectors] = None) -> Vectors:
        """The velocity of each point, m/s. `out` is an array to write into."""
    def records(self, points: Optional[Iterable[Point]] = None) -> NDArray[Any]:
        """Points with all that is known of them, as in `Run.points`; all points if none is named."""
    @property
    def energy_j(self) -> dict[str, float]:
        """The energy of the tissue: kinetic, spring and virtual."""
    def save(self) -> bytes:
        """A snapshot, for `restore`."""

class Journal:
    """A recorded session: a file of `palpate serve --journal`."""

    def __init__(self, path: Source) -> None: ...
    @property
    def info(self) -> dict[str, Any]:
        """What it is of: scene, first and last step, and more, by name."""
    def tools(self) -> dict[int, _ToolCourse]:
        """What each tool did and felt, by its number."""
    def commands(self) -> Commands:
        """Every command, by the step at which it acted."""
    def verify(self) -> Verdict:
        """Simulates it again, and compares every hash and snapshot."""
    def session(self, step: Optional[int] = None) -> Session:
        """The session when so many steps were done; at the end if None."""

class Offline:
    """A touch loop without a network: the same messages, places and times give the same forces, bit by bit, as in every other language.

    `limits` are those of a device, as of a Course. Places are from the middle of the device's workspace, which is laid on `middle_m` of
    the tissue (give its `top_m`, as a server does); or, `in_tissue_frame`, in the tissue's own frame.
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
        """A message of the server arrives now: the bytes of a `palpate.v1.TouchResponse`. The next tick knows it."""
    def tick(self, place_m: Vector, time_s: float, enable: bool = True) -> tuple[float, float, float]:
        """The force to render from now on, N, for a device that is here at `time_s`, a time of any origin. A change of enable from False to
        True asks for forces. Without a connection (an `opened` that has arrived) there are none."""
    def disable(self) -> None:
        """Stops rendering until it is enabled again."""
    @property
    def state(self) -> Literal["waiting", "disabled", "enabled", "paused", "fault"]:
        """Whether forces are rendered: "waiting" before a connection, "disabled" until forces are asked for, "enabled",
        "paused" after a silence, "fault" after a position that is not finite or outside the workspace."""
    @property
    def place_m(self) -> tuple[float, float, float]:
        """Where the tool was at the last tick, in the tissue's frame."""
    @property
    def age_s(self) -> Optional[float]:
        """How old the newest news of the tissue is; None before the first."""

class Samples(Iterator[dict[str, Any]]):
    """The samples of a session, one after the other: what tools feel. Each is a dictionary:

    - `step`: steps done; `time_s`: simulated time.
    - `awake_points`: points that the step computed; `asleep`: nothing moves; `held`: the guard has ended the session.
    - `overruns`: steps that were due and dropped; `time_dilation`: simulated over real time; `late_commands`: commands that came
      too late for their step; `dropped_samples`: samples that this reader was too slow for. Counts are since the session began.
    - `tools`: by its number, each tool that does something, as a dictionary. `displacement_m`: how far the tissue under the tool is from
      where it rests, under a tip the mean over its disc; `surface_displacement_m`: the same of the surface just under its centre;
      `velocity_m_per_s`; `force_on_tool_n`: the force of the tissue on the tool; `applied_force_n`: the force of all tools on the tissue
      there; all in the tissue's frame. `late`: its newest command came too late; `expired`: what it did has ended by itself; `stale`:
      no pose came for 50 ms.
    """

    def take(self, count: int) -> Sampled:
        """The next samples, as arrays."""
    def __next__(self) -> dict[str, Any]: ...

class Frames(Iterator[Frame]):
    """The frames of a session, one after the other: the moving surface."""

    def __next__(self) -> Frame: ...

class RemoteSession:
    """A session of a server. `with` deletes it at the end. In a fleet it is followed to whichever server has it: calls and streams go on
    there."""

    @property
    def id(self) -> str:
        """The id of the session, for `Client.session`."""
    @property
    def server(self) -> str:
        """URL of the server that had it at last."""
    def status(self) -> dict[str, Any]:
        """How the session stands: state, step, points, held tools, and more."""
    def start(self, *, until_step: Optional[int] = None) -> int:
        """Lets it run, until a step if one is named; gives the step that comes next."""
    def pause(self) -> None:
        """Holds it after the step that is under way."""
    def change(
        self,
        *,
        stiffness_n_per_m: Optional[float] = None,
        damping_n_s_per_m: Optional[float] = None,
        anchor_stiffness_n_per_m: Optional[float] = None,
        volume_stiffness_pa: Optional[float] = None,
        at_step: Optional[int] = None,
    ) -> int:
        """Makes the tissue softer or stiffer, from a step on if one is named; gives that step. What is not named stays
        as it is."""
    def hash(self, *, at_step: Optional[int] = None) -> tuple[int, str]:
        """How many steps were done and the hash of the state then: after so many, or now."""
    def save(self) -> bytes:
        """A journal of this moment (MCAP), for `Journal`."""
    def delete(self) -> None:
        """Ends it for everybody."""
    def samples(self, *, every_steps: int = 1, heartbeat_s: Optional[float] = None) -> Samples:
        """The samples of all tools from now on: of every step, or of every so many. `heartbeat_s` is how often one
        comes of a tissue at rest."""
    def frames(self, *, rate_hz: float = 60.0, refinement: int = 0, precise: bool = True) -> Frames:
        """The surface from now on, at most `rate_hz` times a second. `refinement` puts so many vertices between two of
        the tissue; not `precise` halves the bytes."""
    def mesh(self, *, refinement: int = 0) -> dict[str, Any]:
        """What of the surface stays: grid, rest_m, uv, triangles, file_vertex."""
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
    ) -> Touched:
        """Touches with a device at 1 kHz, on a thread of its own, by the rendering law and within the safety envelope.

        `device` is a Course, or an object with `read()`, which returns ((x, y, z), enable), and `write(force_n)`, and perhaps
        `limits`, as a Course has them. A change of enable from False to True asks for forces. `prediction` says of which tissues
        the loop simulates a copy, so that forces come without the delay of the network: "auto", of meshes; "always"; "never".
        Warns (RuntimeWarning) if no force was felt at all. Raises Refused, reason TOOL_HELD, if somebody holds the tool, this
        session object included.
        """
    def pose(self, tool: int, place_m: Vector, tip: Optional[Tip] = None) -> None:
        """Brings a tool with a tip here by the end of the next step, and takes the tool first if that is needed. It stays here until it
        is told something else, also when the session moves. Raises Refused, reason TOOL_HELD, if another has the tool."""
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
        """Pushes at a point or a place; at a distance r from there by force_n * exp(-falloff_per_m * r +
        falloff_offset)."""
    def grasp(self, tool: int, point: Point, displacement_m: Vector) -> None:
        """Holds a point, and brings it this far from where it rests."""
    def release(self, tool: int) -> None:
        """Ends what a tool does, and gives it back."""
    def play(self, script: Union[Script, Source], *, scene: Optional[Union[Scene, Source]] = None) -> Run:
        """Plays a script in real time, each command at its exact step, from the session's step on. The session must stand, and stands at
        the end. From step 0 on the records are those of `run(..., held=True)`. A session on a mesh needs its `scene`, unless you made it
        from one."""
    def __enter__(self) -> RemoteSession: ...
    def __exit__(self, *raised: object) -> None: ...

class Client:
    """A connection to a server."""

    def scenes(self) -> list[str]:
        """The names of the scenes that the server has."""
    def sessions(self) -> list[dict[str, Any]]:
        """How each of its sessions stands, as `RemoteSession.status` tells."""
    def create_session(
        self, scene: Union[str, Scene], *, paused: bool = False, idle_timeout_s: Optional[float] = None
    ) -> RemoteSession:
        """A session of a scene that the server has, by its name, or of one of yours. A session that nobody uses for
        `idle_timeout_s` is deleted."""
    def load(
        self, plan: Union[Source, dict[str, Any]], *, report: Optional[Union[str, PathLike[str]]] = None
    ) -> dict[str, Any]:
        """Loads the server with users by a plan, as `palpate-client load --plan` does, and gives the report. `plan` is
        a file (TOML), its text, or a dict with the same keys. `report` is a file to write a page with plots to (HTML).
        "kept" of the report tells whether all objectives were met and no stream broke, "why" what was not; see
        docs/operating.md. Ctrl-C ends it, and deletes its sessions."""
    def session(self, session_id: str) -> RemoteSession:
        """The session of an id. Raises Refused if there is none."""

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
def run(
    scene: Union[Scene, Tissue, Source], script: Union[Script, Source], *, held: bool = False, audit: bool = False
) -> Run:
    """Plays a script, with the numbers and the hash of `palpate run`. `held` holds forces within each step, as a client does;
    `audit` plays it a second time in f64 with a quarter of the substep, and tells the difference (summary["audited_error"])."""

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
    """Runs of many cases (scene, script) over threads, in their order; by default as many threads as there are processors.
    `progress` is called with how many are done and how many there are."""

def scenes(folder: Source = "scenes") -> list[str]:
    """The names of the scenes that are shipped, and of the files in a folder."""
def scripts(folder: Source = "scripts") -> list[str]:
    """The names of the scripts that are shipped, and of the files in a folder."""
def devices() -> list[str]:
    """The names of the devices whose limits are known."""
