"""A .glb against the rules of KHR_gaussian_splatting, as JSON Schema, and against Khronos' validator.

The schemas of the extension are restated here. Sources: ``extensions/2.0/Khronos/KHR_gaussian_splatting`` of
KhronosGroup/glTF: its ``schema/mesh.primitive.KHR_gaussian_splatting.schema.json``, and the tables of its README.md.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from foreign_files import small_field

from sundae_ns.storage.gltf import EXTENSION, write_glb

jsonschema = pytest.importorskip("jsonschema")
PACKAGES = Path(__file__).parents[2] / "web" / "tests"
needs_validator = pytest.mark.skipif(
    shutil.which("node") is None or not (PACKAGES / "node_modules" / "gltf-validator").is_dir(),
    reason="web/tests has no gltf-validator (make browser)",
)
Json = dict[str, Any]

FLOAT: Json = {"properties": {"componentType": {"const": 5126}, "normalized": {"const": False}}}


def normalized(*components: int) -> Json:
    """Accessors of integers that stand for shares."""
    return {
        "properties": {"componentType": {"enum": list(components)}, "normalized": {"const": True}},
        "required": ["normalized"],
    }


def attribute(kind: str, *components: Json) -> Json:
    """An accessor of a type, with one of these components."""
    return {"required": ["type", "count"], "properties": {"type": {"const": kind}}, "anyOf": list(components)}


def coefficients(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]


SCHEMA: Json = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "type": "object",
    "required": ["extensionsUsed", "meshes"],
    "properties": {
        "extensionsUsed": {"type": "array", "contains": {"const": EXTENSION}, "uniqueItems": True},
        "meshes": {"items": {"properties": {"primitives": {"items": {"$ref": "#/$defs/primitive"}}}}},
    },
    "$defs": {
        "primitive": {
            "required": ["attributes", "mode", "extensions"],
            "properties": {
                "mode": {"const": 0},
                "attributes": {"$ref": "#/$defs/attributes"},
                "extensions": {"required": [EXTENSION], "properties": {EXTENSION: {"$ref": "#/$defs/splats"}}},
            },
        },
        "splats": {
            "type": "object",
            "required": ["kernel", "colorSpace"],
            "properties": {
                "kernel": {"type": "string", "const": "ellipse"},  # the schema takes any word, for extensions
                "colorSpace": {"type": "string", "enum": ["srgb_rec709_display", "lin_rec709_display"]},
                "projection": {"type": "string", "const": "perspective"},
                "sortingMethod": {"type": "string", "const": "cameraDistance"},
                "extensions": {"type": "object"},
                "extras": {},
            },
        },
        "attributes": {
            "type": "object",
            "required": [
                "POSITION",
                *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")),
                *coefficients(0),
            ],
            "properties": {
                "POSITION": {**attribute("VEC3", FLOAT), "required": ["type", "count", "min", "max"]},
                "COLOR_0": {"properties": {"type": {"enum": ["VEC3", "VEC4"]}}},
                f"{EXTENSION}:ROTATION": attribute("VEC4", FLOAT, normalized(5120, 5122)),
                f"{EXTENSION}:SCALE": attribute(
                    "VEC3", FLOAT, {"properties": {"componentType": {"enum": [5120, 5122]}}}
                ),
                f"{EXTENSION}:OPACITY": attribute("SCALAR", FLOAT, normalized(5121, 5123)),
                **{name: attribute("VEC3", FLOAT) for degree in range(4) for name in coefficients(degree)},
            },
            "additionalProperties": False,
            # A degree is whole, and those below it are there.
            "dependentRequired": {
                name: [other for below in range(degree + 1) for other in coefficients(below)]
                for degree in (1, 2, 3)
                for name in coefficients(degree)
            },
        },
    },
}


def document_of(path: Path) -> Json:
    """The JSON of a file, with accessors in place of their indices."""
    data = path.read_bytes()
    document: Json = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["attributes"] = {name: document["accessors"][i] for name, i in primitive["attributes"].items()}
    return document


def faults(document: Json) -> list[str]:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    return [error.message for error in jsonschema.Draft202012Validator(SCHEMA).iter_errors(document)]


def written(path: Path, degree: int = 3) -> Path:
    write_glb(path, small_field(30, degree), antialiased=True, in_model_frame=True)
    return path


@pytest.mark.parametrize("degree", range(4))
def test_a_file_follows_the_schema(tmp_path: Path, degree: int) -> None:
    document = document_of(written(tmp_path / "a.glb", degree))
    assert faults(document) == []
    (primitive,) = document["meshes"][0]["primitives"]
    assert len(primitive["attributes"]) == 5 + (degree + 1) ** 2
    assert {accessor["count"] for accessor in primitive["attributes"].values()} == {30}


def test_a_file_of_another_program_does_too() -> None:
    assert faults(document_of(Path(__file__).parent / "foreign" / "splat_transform.glb")) == []


def parts(document: Json) -> dict[str, Json]:
    """The objects of a document with properties that the extension requires."""
    (primitive,) = document["meshes"][0]["primitives"]
    return {
        "document": document,
        "primitive": primitive,
        "attributes": primitive["attributes"],
        "splats": primitive["extensions"][EXTENSION],
        "position": primitive["attributes"]["POSITION"],
    }


REQUIRED = [
    ("document", "extensionsUsed"),
    ("primitive", "mode"),
    ("primitive", "extensions"),
    ("splats", "kernel"),
    ("splats", "colorSpace"),
    ("position", "min"),
    ("position", "max"),
    *(("attributes", name) for name in SCHEMA["$defs"]["attributes"]["required"]),
    *(("attributes", name) for degree in (1, 2, 3) for name in coefficients(degree)[:1]),
]


@pytest.mark.parametrize(("part", "name"), REQUIRED)
def test_a_missing_property_is_noticed(tmp_path: Path, part: str, name: str) -> None:
    document = document_of(written(tmp_path / "a.glb"))
    del parts(document)[part][name]
    assert any(name in fault for fault in faults(document))


@pytest.mark.parametrize(
    ("part", "changes"),
    [
        ("primitive", {"mode": 4}),
        ("splats", {"kernel": "box"}),
        ("splats", {"colorSpace": "srgb"}),
        ("position", {"type": "VEC4"}),
        ("attributes", {"_ROTATION": {}}),
        ("attributes", {f"{EXTENSION}:OPACITY": {"type": "SCALAR", "count": 30, "componentType": 5121}}),
    ],
)
def test_an_odd_property_is_noticed(tmp_path: Path, part: str, changes: Json) -> None:
    document = document_of(written(tmp_path / "a.glb"))
    parts(document)[part].update(changes)
    assert faults(document)


VALIDATE = """
import { readFileSync } from "node:fs";
import validator from "gltf-validator";
const { issues } = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[1])), { maxIssues: 0 });
console.log(JSON.stringify(issues.messages));
"""


def issues(path: Path) -> list[tuple[str, str]]:
    """Codes and places of all that Khronos' validator says of a file, hints included."""
    words = ["node", "--input-type=module", "--eval", VALIDATE, str(path)]
    found = subprocess.run(words, cwd=PACKAGES, check=True, capture_output=True, text=True).stdout
    return [(issue["code"], issue.get("pointer", "")) for issue in json.loads(found)]


UNKNOWN = ("UNSUPPORTED_EXTENSION", "/extensionsUsed/0")
"""The validator does not know the extension, so that it takes its names of attributes for wrong ones."""


@pytest.mark.browser
@needs_validator
@pytest.mark.parametrize("degree", [0, 3])
def test_the_validator_has_nothing_to_say_but_that_it_does_not_know_the_extension(tmp_path: Path, degree: int) -> None:
    path = written(tmp_path / "a.glb", degree)
    names = [f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")]
    names += [name for each in range(degree + 1) for name in coefficients(each)]
    place = "/meshes/0/primitives/0/attributes/"
    assert sorted(issues(path)) == sorted(
        [UNKNOWN, *(("MESH_PRIMITIVE_INVALID_ATTRIBUTE", place + name) for name in names)]
    )
    # With names that applications may choose, of the same length, it looks at these attributes, too.
    path.write_bytes(path.read_bytes().replace(f"{EXTENSION}:".encode(), b"_HR_GAUSSIAN_SPLATTING_"))
    assert issues(path) == [UNKNOWN]


FAULTS: dict[str, tuple[Callable[[str], str], str]] = {
    "a wrong bound": (lambda text: re.sub(r'"max":\[0', '"max":[1', text, count=1), "ACCESSOR_MAX_MISMATCH"),
    "a wrong count": (lambda text: text.replace('"count":30', '"count":31', 1), "ACCESSOR_TOO_LONG"),
    "no version": (lambda text: text.replace('"version":"2.0"', '"versiom":"2.0"'), "UNDEFINED_PROPERTY"),
}


@pytest.mark.browser
@needs_validator
@pytest.mark.parametrize("kind", FAULTS)
def test_the_validator_would_notice(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / "a.glb", 0)
    data = path.read_bytes()
    end = 20 + int.from_bytes(data[12:16], "little")
    change, code = FAULTS[kind]
    text = change(data[20:end].decode())
    assert text.encode() != data[20:end]
    path.write_bytes(data[:20] + text.encode() + data[end:])
    assert code in [code for code, _ in issues(path)]
