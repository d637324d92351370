"""The text of a calibration file to entries or to lines of words: JSON, YAML in OpenCV's dialect too, OpenCV's XML."""

import json
import re
from collections.abc import Mapping
from typing import Any, NamedTuple
from xml.etree import ElementTree

from jaxtri.errors import CameraError
from jaxtri.formats.entries import Entries


class Line(NamedTuple):
    """A line of a text without names.

    Attributes:
        number: Which of the file, from 1.
        words: Its words; commas part them, too.
    """

    number: int
    words: list[str]


def parse(text: str) -> Entries | list[Line]:
    """Entries of JSON, YAML and OpenCV's XML; lines of any other text. Raises `CameraError` saying where it breaks."""
    if "\0" in text:
        raise CameraError("is binary; export it as text")
    start = text.lstrip()[:1]
    # Without remarks: what follows a colon in those is no entry.
    bare = re.sub(r"(?m)(^|\s)#.*$", "", text)
    if start == "{":
        tree = _json(text)
    elif start == "<":
        tree = _xml(text)
    elif start == "%" or re.search(r"[:\[\]{}]", bare):
        tree = _yaml(text)
    else:
        rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(bare.splitlines(), 1)]
        return [Line(number, words) for number, words in rows if words]
    if not isinstance(tree, Mapping):
        raise CameraError("cannot be parsed: it holds no names with values")
    return Entries(tree)


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise CameraError(f"cannot be parsed as JSON: {error}") from error


def _yaml(text: str) -> Any:
    """The first document that holds something.

    All scalars are texts: YAML 1.1 takes 1e-5 for none but a text, and 10:30:00 for a number.
    """
    import yaml  # here only, as few need it

    # OpenCV's head is no directive of YAML, and its dialect needs no space after a colon.
    text = re.sub(r"\A\s*%YAML[: ][\d.]+[^\n]*", "", text)
    text = re.sub(r'(?m)^([ \t]*[A-Za-z_][\w.]*):(?=[-+.\d"\[!{])', r"\1: ", text)
    text = re.sub(r'([{,]\s*[A-Za-z_]\w*):(?=[-+.\d"\[!{])', r"\1: ", text)
    try:
        # Unknown tags, as OpenCV's and those of Python's objects, are but marks on plain nodes to this loader.
        documents = yaml.load_all(text, Loader=yaml.BaseLoader)
        return _nested(next((d for d in documents if d), None))
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        raise CameraError(f"cannot be parsed as YAML: {getattr(error, 'problem', error)}{where}") from error


def _nested(tree: Any) -> Any:
    """Entries with a dot in their name, as ORB-SLAM's Camera.fx, as entries of an entry."""
    if not isinstance(tree, Mapping):
        return tree
    found: dict[str, Any] = {}
    for key, value in tree.items():
        group, _, name = key.partition(".")
        inside = found.setdefault(group, {}) if name and group.isidentifier() else None
        if isinstance(inside, dict):
            inside[name] = value
        else:
            found[key] = value
    return found


def _xml(text: str) -> Any:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CameraError(f"cannot be parsed as XML: {error}") from error
    if root.tag != "opencv_storage":
        raise CameraError(f"is XML of <{root.tag}>; only OpenCV's, <opencv_storage>, is read")

    def value(element: ElementTree.Element) -> Any:
        if len(element) and all(child.tag == "_" for child in element):
            return [value(child) for child in element]
        if len(element):
            return {child.tag: value(child) for child in element}
        return (element.text or "").strip().strip('"')

    return value(root) if len(root) else {}
