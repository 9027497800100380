"use strict";
(async () => {
  const item = JSON.parse(document.getElementById("map-data").textContent);
  const layers = JSON.parse(document.getElementById("map-layers").textContent);
  await Bokeh.embed.embed_item(item, "map");
  const found = Bokeh.documents[Bokeh.documents.length - 1];
  const models = [...found.roots()].flatMap((root) => [...root.references()]);
  const plans = models.filter((model) => model.type === "Figure");

  const width = document.getElementById("map").clientWidth;
  for (const plan of plans) plan.height = Math.min(plan.height, Math.max(260, width));

  // what the map shows by pointing and dragging, also by the keyboard
  const controls = document.getElementById("controls");
  const button = (text, name, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.setAttribute("aria-label", name);
    made.addEventListener("click", act);
    controls.append(made);
  };
  const scale = (factor) => {
    for (const range of new Set(plans.flatMap((plan) => [plan.x_range, plan.y_range]))) {
      const middle = (range.start + range.end) / 2, half = (factor * (range.end - range.start)) / 2;
      range.setv({ start: middle - half, end: middle + half });
    }
  };
  button("+", "Zoom in", () => scale(0.7));
  button("\u2212", "Zoom out", () => scale(1 / 0.7));
  button("Reset", "Show the whole map", () => plans.forEach((plan) => plan.reset.emit()));
  for (const [tag, text] of layers) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = true;
    box.name = tag;
    box.addEventListener("change", () => {
      for (const model of models) if ((model.tags ?? []).includes(tag)) model.visible = box.checked;
    });
    label.append(box, text);
    controls.append(label);
  }
  controls.hidden = false;

  // letters and axes in the colours of the page
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const paint = () => {
    const ink = getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
    const soft = getComputedStyle(document.documentElement).getPropertyValue("--soft").trim();
    for (const model of models) {
      if (model.type === "LinearAxis") {
        model.setv({ axis_label_text_color: ink, major_label_text_color: ink, axis_line_color: soft,
          major_tick_line_color: soft, minor_tick_line_color: soft });
      } else if (model.type === "Legend") {
        model.setv({ label_text_color: ink, background_fill_alpha: 0 });
      } else if (model.type === "Text") {
        model.text_color = { value: soft };
      }
    }
  };
  dark.addEventListener("change", paint);
  paint();
})();
