"""The interactive map of a report: its model as JSON, and Bokeh's own script beside it, so that it works offline."""

import json
from typing import Any, NamedTuple

import xarray as xr
from bokeh.embed import json_item
from bokeh.resources import Resources

from probcal.plots.interactive import interactive_map, layers
from probcal.plots.scene import scene


class Chart(NamedTuple):
    """The data that a page needs to show the map."""

    data: str  # JSON that may stand in a page
    layers: dict[str, str]  # tags and what they are called
    libraries: list[str]  # scripts


def chart(tree: xr.DataTree) -> Chart:
    """The map of a fit; the same tree gives the same text."""
    item = json_item(interactive_map(tree))
    text = json.dumps(_renamed(item, {}), separators=(",", ":"), allow_nan=False)
    libraries = Resources(mode="inline", components=["bokeh"]).js_raw[:1]
    return Chart(
        text.replace("<", "\\u003c"),
        layers(scene(tree)),
        [text.replace("</script", "<\\/script") for text in libraries],
    )


def _renamed(part: Any, names: dict[str, str]) -> Any:
    """The same model with its names of objects, which count on from page to page, counted from 1."""
    if isinstance(part, dict):
        own = dict(part)
        for key in ("id", "root_id"):
            if isinstance(own.get(key), str):
                own[key] = names.setdefault(own[key], f"m{len(names) + 1}")
        return {key: value if key in ("id", "root_id") else _renamed(value, names) for key, value in own.items()}
    return [_renamed(one, names) for one in part] if isinstance(part, list) else part
