"""The schema of summary.json: kinds of the values that reports, methods and comparisons read.

A results folder may come from someone else. A key below must have a value of the kind that tkamb
writes; otherwise the folder is refused. Other keys may have any value.
"""

from typing import Annotated, Any, Literal, NotRequired

from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from tkamb.errors import InputError

Number = Annotated[float, Field(ge=-1e15, le=1e15, allow_inf_nan=False)]
"""A finite number. No quantity of a run is beyond 1e15, and its square is finite."""
Count = Annotated[int, Field(ge=0, le=10**12)]
Known = Number | None
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Texts = list[str]
Words = dict[str, Any]


class Peak(TypedDict, total=False):
    """The peak of a force over the samples."""

    words: str
    median: Known
    p05: Known
    p95: Known
    nominal_percentile: Known


class PeakForce(TypedDict):
    """A peak force without bands, with the band from the inputs, or with both bands."""

    nominal: Number
    median: NotRequired[Known]
    p05: NotRequired[Known]
    p95: NotRequired[Known]
    discrepancy_p05: NotRequired[Known]
    discrepancy_p95: NotRequired[Known]


class Inside(TypedDict):
    """How often a band holds the measured force."""

    frames: Count
    share: Known


class Uncertainty(TypedDict):
    """The study of varied inputs."""

    samples: Count
    not_varied: Texts
    largest_failed_share: Number
    peak_force_total_BW: NotRequired[Peak | None]
    peaks_BW: NotRequired[dict[str, PeakForce] | None]
    causes_of_failure: NotRequired[Words | None]
    unbalanced_patella: NotRequired[str]
    shares_of_variance: NotRequired[dict[str, dict[str, Known]] | None]
    measured_inside: NotRequired[dict[str, Inside] | None]


class Contact(TypedDict):
    """The contact model."""

    model: str
    resolution_mm: Number
    material: NotRequired[str | None]
    released: NotRequired[Texts | None]
    coupling: NotRequired[str | None]
    options: NotRequired[Words | None]


class Material(TypedDict):
    """The material of the insert, with the numbers of its law."""

    name: str
    young_modulus_MPa: Number
    poisson_ratio: Number
    sources: Texts
    law: str
    alpha: NotRequired[Number]
    reference_stress_MPa: NotRequired[Number]
    exponent: NotRequired[Number]
    strain: NotRequired[list[Number]]
    stress_MPa: NotRequired[list[Number]]


class PeakPressure(TypedDict):
    """The largest pressure of the run."""

    MPa: Number
    side: str
    frame: Count
    time_s: Number
    doubt: NotRequired[str | None]


class Measured(TypedDict):
    """Predicted and measured forces of one side."""

    frames_compared: Count
    frames_failed: Count
    frames_without_measurement: Count
    frames_without_prediction: Count
    measured_where_not_compared_N: list[Number]
    predicted: NotRequired[str]
    rmse_N: NotRequired[Number]
    rmse_BW: NotRequired[Number]
    bias_N: NotRequired[Number]
    r_squared: NotRequired[Known]
    pearson_r: NotRequired[Known]
    peak_predicted_N: NotRequired[Number]
    peak_predicted_time_s: NotRequired[Number]
    peak_measured_N: NotRequired[Number]
    peak_measured_time_s: NotRequired[Number]


class Errors(TypedDict):
    """The largest relative errors of the contact model in the reference cases."""

    mean_pressure: Number
    peak_pressure: Number
    area: Number
    approach: NotRequired[Number]
    force: NotRequired[Known]


class KnownError(Errors):
    """Errors, and those of single situations."""

    cases: Count
    situations: NotRequired[dict[str, Errors] | None]


class Gait(TypedDict):
    """Stance and toe-off."""

    stance_s: list[Pair]
    toe_off_percent: list[Number]


class Reserve(TypedDict):
    """A reserve moment of the static optimisation."""

    largest_Nm: Number
    percent_of_largest_moment: Number
    frames_above_5_percent: Count


class Mesh(TypedDict):
    """Size of a mesh."""

    triangles: Count
    edge_mm: Number


class Measures(TypedDict):
    """Sizes and rates that the Methods paragraph states."""

    meshes: dict[str, Mesh]
    frame_rate_Hz: NotRequired[Number]
    insert_thickness_mm: NotRequired[Pair]
    tolerances: NotRequired[dict[str, Number]]


class Strain(TypedDict):
    """Ligament strain over flexion."""

    flexion_deg: list[Number]
    strain: dict[str, list[Known]]


class Channel(TypedDict):
    """Agreement of an activation with its EMG channel."""

    channel: str
    pearson_r: Known


class Emg(TypedDict, total=False):
    """Agreement of activations and EMG."""

    muscles: dict[str, Channel] | None
    settings: Any


class Patient(TypedDict):
    """[patient] of the scene."""

    side: str
    mass_kg: Number
    height_mm: NotRequired[Known]
    sex: NotRequired[str | None]


class Tables(TypedDict):
    """Tables of the scene."""

    patient: Patient
    motion: Words
    ground_reaction: NotRequired[Words | None]
    ligament: NotRequired[list[Words] | None]
    generic_ligaments: NotRequired[Words | None]
    patella: NotRequired[Words | None]
    quadriceps: NotRequired[Words | None]
    muscle: NotRequired[list[Words] | None]
    muscles: NotRequired[Words | None]
    contact: NotRequired[Contact | None]
    implant: NotRequired[Words | None]


class Preset(TypedDict):
    """The published study whose choices the run made."""

    name: str


class Summary(TypedDict, total=False):
    """Content of summary.json. Any key may be missing or null."""

    title: str | None
    scene: str | None
    scene_sha256: str | None
    command: str | None
    started: str | None
    overrides: Words | None
    preset: Preset | None
    versions: dict[str, str] | None
    seconds: dict[str, Known] | None
    side: Literal["left", "right"] | None
    frame: str | None
    body_mass_kg: Known
    height_mm: Known
    yield_stress_MPa: Known
    axis: Literal["flexion", "cycle", "time"] | None
    lateral_axis: str | None
    activity: str | None
    frames: Count | None
    failed_frames: list[Any] | None
    flagged_frames: Count | None
    peak_force_total_BW: Known
    peaks_BW: dict[str, PeakForce] | None
    peak_pressure: PeakPressure | None
    discrepancy: Words | None
    gait: Gait | None
    saturated_muscles: dict[str, Count] | None
    not_modelled: Texts | None
    assumptions: Texts | None
    notes: Texts | None
    residuals: str | None
    questions: Texts | None
    remarks: Texts | None
    scene_tables: Tables | None
    changed_settings: Words | None
    measures: Measures | None
    ligament_strain: Strain | None
    first_wrapping_flexion_deg: Known
    muscle_groups: dict[str, Texts] | None
    reserves: dict[str, Reserve] | None
    measured: dict[str, Measured] | None
    emg: Emg | None
    contact: Contact | None
    material: Material | None
    known_error: str | KnownError | None
    split_not_determined_frames: Count | None
    cycle_percent_s: Pair | None
    uncertainty: Uncertainty | None
    identity: Words | None
    inputs: dict[str, str] | None
    files: dict[str, str] | None
    summary_sha256: str | None
    resumed_frames: Count | None
    unfinished_frames: Count | None


_SCHEMA = TypeAdapter(Summary)


def check_summary(summary: object, path: object) -> None:
    """Raise unless the values of a summary have the kinds that tkamb writes.

    Args:
        summary: content of a summary.json.

    Raises:
        InputError: a value has another kind, or is missing.
    """
    try:
        _SCHEMA.validate_python(summary, strict=True)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        hint = "give a folder that `tkamb run` wrote, or run it again"
        raise InputError(f"is damaged: '{where}' {first['msg'].lower()}", path, hint) from None
