"""What a figure of the page can be saved as: PNG, SVG, and the numbers that are drawn as CSV.

All of it happens in the browser, on what is drawn there at that moment: nothing is asked of the server.
"""

from __future__ import annotations

import re

from bokeh.models import CustomAction, CustomJS, SaveTool
from bokeh.plotting import figure

_SAVE = """
function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob); link.download = name;
  document.body.append(link); link.click(); link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
"""
_SVG = (
    _SAVE
    + """
export default async ({plot, name}, obj, data, {index}) => {
  const view = index.get_by_id(plot.id) ?? index.find_one(plot);
  save(await view.export("svg").to_blob(), `${name}.svg`);
}
"""
)
#: Sources of a figure one after the other; times along the axis as ISO 8601.
_CSV = (
    _SAVE
    + """
const quoted = (value) => {
  const text = value === null || value === undefined || Number.isNaN(value) ? "" : String(value);
  return /[",\\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
};
const time = (value) => Number.isFinite(value) ? new Date(value).toISOString() : value;
const field = (glyph, name) => glyph[name]?.field;
function rows_of(glyph, source, dated) {
  const columns = source.data instanceof Map ? source.data : new Map(Object.entries(source.data));
  const image = field(glyph, "image");
  if (image !== undefined) {
    const rows = [["x", "y", image]];
    columns.get(image).forEach((grid, at) => {
      const [high, wide] = grid.shape ?? [grid.length, grid[0].length];
      const number = (name) => columns.get(field(glyph, name))?.[at] ?? glyph[name].value;
      const [x, y, dw, dh] = ["x", "y", "dw", "dh"].map(number);
      for (let i = 0; i < high; i++) for (let j = 0; j < wide; j++)
        rows.push([dated ? time(x + (j + 0.5) * dw / wide) : x + (j + 0.5) * dw / wide,
                   y + (i + 0.5) * dh / high, grid.shape ? grid[i * wide + j] : grid[i][j]]);
    });
    return rows;
  }
  const along = ["x", "x0", "x1", "left", "right"].map((name) => field(glyph, name));
  const names = [...columns.keys()].filter((name) => name !== "colour");
  const size = Math.max(0, ...names.map((name) => columns.get(name).length));
  const rows = [names];
  for (let at = 0; at < size; at++) rows.push(names.map((name) => {
    const value = columns.get(name)[at];
    return dated && along.includes(name) && typeof value === "number" ? time(value) : value }));
  return rows;
}
export default ({plot, name}) => {
  const axes = [...plot.below, ...plot.left].filter((one) => one.axis_label !== undefined);
  const dated = plot.below.some((one) => one.type === "DatetimeAxis");
  const lines = [`# ${plot.title?.text ?? name}`, ...axes.map((one) => `# axis: ${one.axis_label ?? ""}`)];
  const seen = new Set();
  for (const one of plot.renderers) {
    if (!one.data_source || seen.has(one.data_source.id)) continue;
    seen.add(one.data_source.id);
    for (const row of rows_of(one.glyph, one.data_source, dated)) lines.push(row.map(quoted).join(","));
    lines.push("");
  }
  save(new Blob([lines.join("\\n")], {type: "text/csv"}), `${name}.csv`);
}
"""
)


def with_export(plot: figure) -> figure:
    """Add tools to a figure that save it as PNG and SVG, and what it draws as CSV."""
    title = plot.title.text if plot.title is not None else ""
    name = re.sub(r"\W+", "-", title).strip("-").lower()[:60] or "figure"
    arguments = {"plot": plot, "name": name}
    plot.add_tools(
        SaveTool(filename=name, description="Save as PNG"),
        *(
            CustomAction(
                description=f"Save as {kind}", icon=_icon(kind), callback=CustomJS(args=arguments, code=code)
            )
            for kind, code in (("SVG", _SVG), ("CSV", _CSV))
        ),
    )
    return plot


def _icon(text: str) -> str:
    """Return three letters as an icon."""
    return (
        "data:image/svg+xml;utf8,<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 24 24'>"
        "<text x='12' y='16' text-anchor='middle' font-size='11' font-family='sans-serif' fill='%23666'>"
        f"{text}</text></svg>"
    )
