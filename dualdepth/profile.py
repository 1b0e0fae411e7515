"""The profile: every setting of a run, read from YAML and validated at once.

An unknown key is an error that names the nearest known one. The sections stand in `dualdepth/settings.py`.
"""

import difflib
import functools
import operator
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from dualdepth.errors import InputError, reading
from dualdepth.networks.architecture import Architecture, Design
from dualdepth.settings import Data, Evaluation, Settings, Training, Variant, World

PROFILES = Path(__file__).parent / "profiles"


class Profile(Settings):
    """Everything a run needs to know."""

    name: str
    about: str  # One sentence for tables and reports: what the numbers of this profile are numbers of.
    verdicts: Literal["none", "directions", "numbers"] = "none"
    """What the report judges: nothing, the direction of the paper's claims, or its numbers as well."""
    seeds: list[Annotated[int, Field(ge=0, lt=2**32)]] = Field([0], min_length=1)
    world: World | None = None
    data: Data
    training: Training = Training()
    evaluation: Evaluation = Evaluation()
    train: dict[str, dict[str, Any] | None] = Field({"lr": None, "dual": None, "dual_no_sa": None}, min_length=1)
    """The variants to train, each with settings of its own by dotted name, such as `{training.hr.max_steps: 6}`."""
    variants: dict[Annotated[str, Field(pattern=r"^[\w-]+$")], Variant] = Field({})
    """Variants of the profile's own, beside those of `dualdepth/variants.yaml`; folders are named by them."""

    @model_validator(mode="after")
    def _fits_together(self) -> "Profile":
        if self.training.precision == "bf16" and max(self.data.lr_size) <= 64:
            raise ValueError(
                "hr_size 192x192 needs precision float32: PoseNet ends in 1x1 maps there, whose bf16 gradients torch 2.13 gets wrong"
            )
        if (self.data.source == "miniature") != (self.world is not None):
            raise ValueError("data.source: miniature needs a section `world`, and only it")
        for name in self.train:
            if self.train[name] or (self.variant(name).set and name != "lr"):  # `of_variant` validates the settings that it changes
                self.of_variant(name)
            start = self.variant(name).starts_from
            if start is not None and start not in self.train:
                raise ValueError(f"train: {name} starts from {start}, which is not trained; name it too")
            if start is not None and self.variant(start).network != "lr":
                raise ValueError(f"train: {name} starts from {start}, which is no variant of stage 1")
            if start is not None and self.variant(start).trains_on != self.variant(name).trains_on:
                raise ValueError(f"train: {name} starts from {start}, which is trained on {self.variant(start).trains_on} frames: a leak")
        if "lr" not in self.train:
            raise ValueError("train: does not name lr, which the tables compare with; name it too")
        return self

    def variant(self, name: str) -> Variant:
        """A variant by name, one of the profile's own or a standard one; an `InputError` that names the nearest where there is none."""
        known = standard_variants() | self.variants
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise InputError(f"variant {name!r} is unknown; did you mean {near}? There are {', '.join(known)}")
        return known[name]

    def architecture(self, name: str) -> Architecture:
        """The depth network that a variant trains."""
        variant = self.variant(name)
        training = self.of_variant(name).training
        residual = variant.network == "dual" and training.beyond_paper_residual
        return Architecture(encoder=training.encoder, residual=residual, **variant.model_dump(include={*Design.model_fields}))

    def trained_on(self, what: str) -> list[str]:
        """The variants to train on frames of the depth tables (`depth`) or of the odometry table (`odometry`)."""
        return [name for name in self.train if self.variant(name).trains_on == what]

    @property
    def pose_variants(self) -> tuple[str, str]:
        """The trainings of stages 1 and 2 whose PoseNets are scored.

        On KITTI the drives of the depth tables and the odometry sequences overlap, so each has trainings of its own; in the synthetic
        world, and in a profile that trains on no sequence, those of the depth tables are scored.
        """
        return ("odometry_lr", "odometry_dual") if self.odometry_sequences()[0] and not self.world else ("lr", "dual")

    def odometry_sequences(self) -> tuple[list[str], list[str]]:
        """Odometry sequences to train on and to score."""
        if self.world is None:
            return self.data.odometry_train, self.data.odometry_test
        return [f"{n:02d}" for n in range(self.world.odometry_train)], [f"{9 + n:02d}" for n in range(self.world.odometry_test)]

    def of_variant(self, name: str) -> "Profile":
        """The profile as a variant trains with it: its own settings and those of `train` put in. An `InputError` names an unknown variant
        or setting, or values that do not fit."""
        changes = self.variant(name).set | (self.train.get(name) or {})
        values = self.model_dump()
        for dotted, value in changes.items():
            *sections, last = dotted.split(".")
            if sections[:1] != ["training"] or isinstance(value, dict):
                raise InputError(f"variant {name}: {dotted} is no single setting of training, such as training.hr.max_steps")
            try:
                functools.reduce(operator.getitem, sections, values)[last] = value
            except (KeyError, TypeError):
                raise InputError(f"variant {name}: {_unknown(dotted)}") from None
        try:
            profile = type(self).model_validate(values | {"train": {"lr": None}})
        except ValidationError as error:
            raise InputError(f"variant {name}: {'; '.join(map(_mistake, error.errors()))}") from None
        if self.variant(name).stage == "hr" and not profile.training.augmentation.augment_first:
            raise InputError(f"variant {name}: training.augmentation.augment_first must be true at high resolution")
        return profile

    def trained_variants(self) -> dict[str, dict[str, Any]]:
        """The variants it trains as plain values, their labels included, and what it sets for each of them."""
        return {name: self.variant(name).model_dump(mode="json") | {"here": self.train[name]} for name in self.train}

    def values(self, *sections: str) -> dict[str, Any]:
        """The named sections (dots go deeper) as plain values, for what to run again."""
        found = {section: functools.reduce(getattr, section.split("."), self) for section in sections}
        return {section: value.model_dump(mode="json") if isinstance(value, BaseModel) else value for section, value in found.items()}


@functools.cache
def standard_variants() -> dict[str, Variant]:
    """The variants of `dualdepth/variants.yaml`, in its order."""
    values = yaml.safe_load((PROFILES.parent / "variants.yaml").read_text(encoding="utf-8"))
    return {name: Variant.model_validate(value) for name, value in values.items()}


def load_profile(name: str) -> Profile:
    """Read and validate a profile: one that comes with the package, such as `tiny`, or a YAML file, by whose stem the run is named.
    An `InputError` says that there is none, no valid YAML, or a bad key or value; it names the file and the nearest known key."""
    path, values = _read(name)
    try:
        return Profile.model_validate({str(key): value for key, value in values.items()} | {"name": path.stem})
    except (ValidationError, InputError) as error:
        said = "; ".join(map(_mistake, error.errors())) if isinstance(error, ValidationError) else error
        raise InputError(f"{path}: {said}") from None


class Once(yaml.SafeLoader):
    """Reads YAML, in which no key may stand twice in a mapping."""

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        """A mapping, as it is written."""
        node = super().compose_mapping_node(anchor)
        keys = [str(key.value) for key, _ in node.value]
        if twice := {key for key in keys if keys.count(key) > 1}:
            raise ValueError(f"line {node.start_mark.line + 1}: {', '.join(sorted(twice))} stands twice")
        return node


def profile_path(name: str) -> Path:
    """The file of a profile, which may not be there."""
    return Path(name) if name.endswith((".yaml", ".yml")) else PROFILES / f"{name}.yaml"


def _read(name: str) -> tuple[Path, dict[str, Any]]:
    """The file of a profile, and its settings laid over those of the profile that it `extends`."""
    path = profile_path(name)
    known = sorted(shipped.stem for shipped in PROFILES.glob("*.yaml") if shipped != path)
    if not path.is_file():
        raise InputError(f"profile {name!r} not found: choose one of {', '.join(known)} or give the path of a .yaml file that is there")
    if not re.fullmatch(r"(?!(kitti|published|lock|home)$)\w[\w.-]*", path.stem):  # which are folders of the project's own
        named = "folders and commands are named by it; name the file with letters, digits, . _ and -, not as a folder of ours"
        raise InputError(f"profile {name}: {named}")
    with reading(path, "give settings in YAML"):
        values = yaml.load(path.read_text(encoding="utf-8-sig"), Once)
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a mapping of settings, found {type(values).__name__}")
    if (base := values.pop("extends", None)) is None:
        return path, values
    if base not in known:
        raise InputError(f"{path}: extends {base!r}, which is no shipped profile; name one of {', '.join(known)}")
    # each profile says itself what its numbers describe and what of them is judged
    return path, _laid_over({k: v for k, v in _read(base)[1].items() if k not in ("about", "verdicts")}, values)


def _laid_over(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """Sections are merged key by key; what is trained is replaced as a whole."""
    for key, value in change.items():
        sections = key != "train" and isinstance(value, dict) and isinstance(base.get(key), dict)
        base = base | {key: _laid_over(base[key], value) if sections else value}
    return base


def _mistake(error: Any) -> str:
    """One validation error as a phrase: where, what, and for an unknown key the nearest known one."""
    where = ".".join(str(part) for part in error["loc"]) or "profile"
    return _unknown(where) if error["type"] == "extra_forbidden" else f"{where}: {error['msg']}"


def _unknown(setting: str) -> str:
    """That there is no such setting, and the nearest one: with the same last word, else a similar one in the same section, else anywhere.
    Of a known one whose dots were written, how sections are written."""
    (section, *entry), last = setting.split(".")[:2], setting.split(".")[-1]
    known = {name: name.split(".") for name in _settings(Profile, entry) if name.startswith("variants.") == (section == "variants")}
    if setting in known:
        return f"{setting}: sections are nested; write {setting.replace('.', ': {')}: …{'}' * setting.count('.')}"
    for names in ([n for n in known if known[n][-1] == last], [n for n in known if known[n][0] == section], known):
        if alike := difflib.get_close_matches(last, {known[n][-1] for n in names}, n=1):
            near = difflib.get_close_matches(setting, [n for n in names if known[n][-1] == alike[0]], n=1, cutoff=0.0)
            return f"unknown setting {setting}; did you mean {near[0]}?"
    return f"unknown setting {setting}; docs/settings.md lists all"


def _settings(section: type[BaseModel], entry: list[str], above: str = "") -> Iterator[str]:
    """Dotted names of a section's settings; a variant's have the name of an `entry`."""
    for key, field in section.model_fields.items():
        yield above + key
        for kind in (field.annotation, *getattr(field.annotation, "__args__", ())):
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield from _settings(kind, entry, ".".join([above + key, *entry * (kind is Variant), ""]))
