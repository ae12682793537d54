// Values, choice of curves and zoom in the figures of the report.
//
// Each figure has an image (SVG) and, in data-panels, its panels: the box of the axes and the box with labels (left,
// top, right, bottom in units of the image), label, limits and scale of x and y, and the curves with the ids of their
// groups in the image. Values are read from the image itself. Without this script the page is complete.

const SVG = "http://www.w3.org/2000/svg";
// Names of which curves can be hidden, by the field of a curve that holds them.
const FIELDS = { experiment: "Experiments", channel: "Channels", curve: "Curves" };
const ZOOM_STEP = 1.5, LARGEST_ZOOM = 12, SAME_PLACE = 0.01, MARK_RADIUS = 3.5, READ_RESOLUTION = 1e-6;
// Numbers of names from which all can be set at once, and from which they are folded away.
const SEVERAL = 5, MANY = 13;
const RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹";
const hidden = { experiment: new Set(), channel: new Set(), curve: new Set() };

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function formatted(value) {
  const [mantissa, exponent] = String(Number(value.toPrecision(4))).split("e");
  const raised = exponent?.replace("+", "").replace("-", "⁻").replace(/\d/g, (digit) => RAISED[digit]);
  return mantissa.replace("-", "−") + (raised ? `×10${raised}` : "");
}

// Coordinates.

function valueAt(axis, fraction) {
  const [low, high] = axis.limits;
  if (axis.scale === "log") return low * (high / low) ** fraction;
  // Coordinates in the image are rounded, so that zero would be a small number.
  const resolution = Math.abs(high - low) * READ_RESOLUTION;
  return Math.round((low + (high - low) * fraction) / resolution) * resolution;
}

function xValue(panel, x) {
  return valueAt(panel.x, (x - panel.box[0]) / (panel.box[2] - panel.box[0]));
}

function yValue(panel, y) {
  return valueAt(panel.y, (panel.box[3] - y) / (panel.box[3] - panel.box[1]));
}

function pairs(path, left = 0, top = 0) {
  const numbers = (path.getAttribute("d").match(/-?\d[\d.]*(?:e[-+]?\d+)?/gi) ?? []).map(Number);
  return Array.from({ length: numbers.length >> 1 }, (_, k) => [left + numbers[2 * k], top + numbers[2 * k + 1]]);
}

// Points of a curve in the image: vertices of a line, places of markers, or vertices of a band.
function pointsOf(group, form) {
  const placed = [...group.querySelectorAll("use")].map((use) => {
    const at = [Number(use.getAttribute("x")), Number(use.getAttribute("y"))];
    const name = use.getAttribute("xlink:href") ?? use.getAttribute("href");
    return { at, path: group.querySelector(`[id="${name.slice(1)}"]`) };
  });
  if (form === "points") return placed.map((mark) => mark.at);
  const drawn = [...group.querySelectorAll("path")].filter((path) => !path.closest("defs"));
  return [...drawn.flatMap((path) => pairs(path)), ...placed.flatMap(({ at, path }) => pairs(path, ...at))];
}

// What is read.

// One stop for each x at which curves of an experiment have values: places [panel, curve, [x, y], …] at this x.
function stopsOf(panels) {
  const groups = new Map();
  for (const panel of panels.filter((p) => p.shown && p.x && p.y)) {
    for (const curve of panel.curves.filter((c) => c.shown && c.form !== "other")) {
      const key = JSON.stringify([curve.experiment, curve.channel, panel.x.label]);
      if (!groups.has(key)) groups.set(key, []);
      groups.get(key).push({ panel, curve });
    }
  }
  // Measured points come first, and panels from above.
  const later = ({ curve }) => Number(curve.form !== "points");
  const order = (a, b) => later(a) - later(b) || a.panel.box[1] - b.panel.box[1];
  return [...groups.values()].flatMap((members) => stopsOfGroup(members.sort(order)));
}

function stopsOfGroup(members) {
  const leads = [], bands = members.filter(({ curve }) => curve.form === "band");
  for (const member of members.filter(({ curve }) => curve.form !== "band")) {
    const { points } = member.curve;
    const lead = leads.find(([{ curve }]) => curve.points.length === points.length
      && curve.points.every(([x], k) => Math.abs(x - points[k][0]) < SAME_PLACE));
    if (lead) lead.push(member);
    else leads.push([member]);
  }
  return leads.flatMap((lead) => lead[0].curve.points.map(([x], k) => ({
    x,
    places: [
      ...lead.map(({ panel, curve }) => ({ panel, curve, points: [curve.points[k]] })),
      ...bands.map(({ panel, curve }) => ({ panel, curve, points: endsAt(curve, x) })),
    ].filter(({ points }) => points.length),
  })));
}

function endsAt(band, x) {
  const there = band.points.filter((point) => Math.abs(point[0] - x) < SAME_PLACE).sort((a, b) => b[1] - a[1]);
  return there.length ? [there[0], there[there.length - 1]] : [];
}

function textOf(stop) {
  const { panel, curve } = stop.places[0], byPanel = new Map();
  for (const place of stop.places) {
    const values = place.points.map(([, y]) => formatted(yValue(place.panel, y))).join(" … ");
    const { label } = place.panel.y, name = label.startsWith(place.curve.curve) ? "" : `${place.curve.curve} `;
    byPanel.set(label, [...(byPanel.get(label) ?? []), name + values]);
  }
  const values = [...byPanel].map(([label, texts]) => `${label}: ${texts.join(", ")}`);
  return [`${curve.experiment}, ${panel.x.label}: ${formatted(xValue(panel, stop.x))}`, ...values].join("; ");
}

// The stop that is nearest to a point of a panel: in x for curves over time, otherwise in x and y.
function nearest(stops, panel, x, y) {
  let best = null, least = Infinity;
  const inside = panel.curves.filter((curve) => curve.shown && curve.form !== "band");
  const overX = inside.every(({ points }) => points.every(([at], k) => !k || at >= points[k - 1][0]));
  const single = overX && new Set(inside.map((curve) => curve.experiment)).size === 1;
  for (const stop of stops) {
    for (const place of stop.places) {
      if (place.panel !== panel || place.curve.form === "band") continue;
      const distance = Math.hypot(stop.x - x, single ? 0 : place.points[0][1] - y);
      if (distance < least) [best, least] = [stop, distance];
    }
  }
  return best;
}

// A figure.

function inlined(image) {
  const bytes = Uint8Array.from(atob(image.src.split(",")[1]), (letter) => letter.charCodeAt(0));
  const read = new DOMParser().parseFromString(new TextDecoder().decode(bytes), "image/svg+xml").documentElement;
  const svg = document.importNode(read, true);
  svg.removeAttribute("width");
  svg.removeAttribute("height");
  svg.setAttribute("aria-hidden", "true");
  svg.style.cssText = "display: block; width: 100%";
  const holder = element("div", { className: `picture ${image.className}` });
  holder.setAttribute("role", "img");
  holder.setAttribute("aria-label", image.alt);
  // Ids of different images may be the same, so that each has a tree of its own.
  holder.attachShadow({ mode: "open" }).append(svg);
  image.replaceWith(holder);
  return { holder, svg };
}

class InteractiveFigure {
  constructor(figure) {
    this.figure = figure;
    this.plate = figure.querySelector(".plate");
    Object.assign(this, inlined(figure.querySelector("img")));
    this.panels = JSON.parse(figure.dataset.panels);
    this.panels.forEach((panel, place) => { panel.group = this.group(`panel-${place}`); });
    this.curves = this.panels.flatMap((panel) => panel.curves);
    for (const curve of this.curves) {
      curve.group = this.group(curve.id);
      curve.points = curve.group ? pointsOf(curve.group, curve.form) : [];
    }
    this.whole = this.svg.getAttribute("viewBox").split(/\s+/).map(Number);
    this.marks = document.createElementNS(SVG, "g");
    this.svg.append(this.marks);
    this.zoom = 1;
    this.addTools();
    this.update();
  }

  group(id) {
    return this.svg.querySelector(`[id="${id}"]`);
  }

  addTools() {
    const caption = this.figure.querySelector("figcaption");
    const button = (text, act) => element("button", { type: "button", textContent: text, onclick: act });
    this.percent = element("output", { textContent: "100 %" });
    this.slider = element("input", { type: "range", min: 0, step: 1, value: 0 });
    this.slider.setAttribute("aria-label", "Point to read");
    this.slider.onfocus = this.slider.oninput = () => this.read(this.stops[this.slider.value]);
    this.values = element("p", { className: "values" });
    const tools = element("div", { className: "tools" },
      button("Zoom out", () => this.enlarge(1 / ZOOM_STEP)), button("Zoom in", () => this.enlarge(ZOOM_STEP)),
      button("Reset", () => this.enlarge(0)), this.percent, this.slider);
    tools.setAttribute("role", "group");
    tools.setAttribute("aria-labelledby", caption.id);
    this.plate.after(element("div", { className: "reading" }, this.values, tools));
    this.plate.addEventListener("keydown", (event) => {
      const factor = { "+": ZOOM_STEP, "=": ZOOM_STEP, "-": 1 / ZOOM_STEP, 0: 0 }[event.key];
      if (factor === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      this.enlarge(factor);
    });
    this.holder.addEventListener("pointermove", (event) => this.point(event));
    this.holder.addEventListener("pointerdown", (event) => this.point(event));
  }

  // Show what is not hidden, without empty space above and below.
  update() {
    const all = (curve) => Object.keys(FIELDS).every((field) => !hidden[field].has(curve[field]));
    for (const panel of this.panels) {
      for (const curve of panel.curves) {
        curve.shown = all(curve);
        if (curve.group) curve.group.style.display = curve.shown ? "" : "none";
      }
      panel.shown = !panel.curves.length || panel.curves.some((curve) => curve.shown);
      if (panel.group) panel.group.style.display = panel.shown ? "" : "none";
    }
    const shown = this.panels.filter((panel) => panel.shown);
    this.figure.hidden = !shown.length;
    const [left, top, width, height] = this.whole;
    const cut = shown.length && shown.length < this.panels.length;
    const above = cut ? Math.max(top, Math.min(...shown.map((panel) => panel.around[1])) - SAME_PLACE) : top;
    const below = cut ? Math.min(top + height, Math.max(...shown.map((panel) => panel.around[3]))) : top + height;
    this.svg.setAttribute("viewBox", [left, above, width, below - above].join(" "));
    this.stops = stopsOf(shown);
    this.slider.hidden = !this.stops.length;
    this.slider.max = Math.max(0, this.stops.length - 1);
    this.slider.value = 0;
    this.slider.setAttribute("aria-valuetext", this.stops.length ? textOf(this.stops[0]) : "");
    this.marks.replaceChildren();
    const how = this.stops.length ? "Point at the figure, or move the slider, to read values." : "";
    this.values.textContent = how || "Point at a panel to read its axes.";
  }

  read(stop) {
    const text = textOf(stop);
    this.values.textContent = text;
    this.slider.value = this.stops.indexOf(stop);
    this.slider.setAttribute("aria-valuetext", text);
    const points = stop.places.flatMap((place) => place.points);
    this.marks.replaceChildren(...points.map(([x, y]) => {
      const mark = document.createElementNS(SVG, "circle");
      for (const [name, value] of Object.entries({ cx: x, cy: y, r: MARK_RADIUS, fill: "none", stroke: "#b00020" })) {
        mark.setAttribute(name, value);
      }
      return mark;
    }));
  }

  point(event) {
    if (event.type === "pointermove" && event.pointerType === "mouse" && event.buttons & 1) {
      this.plate.scrollBy(-event.movementX, -event.movementY);
      return;
    }
    const { left, top, width, height } = this.svg.getBoundingClientRect();
    const [x0, y0, across, down] = this.svg.getAttribute("viewBox").split(/\s+/).map(Number);
    const x = x0 + (event.clientX - left) / width * across, y = y0 + (event.clientY - top) / height * down;
    const within = ([low, high], at) => low <= at && at <= high;
    const panel = this.panels.find(({ box, shown }) =>
      shown && within([box[0], box[2]], x) && within([box[1], box[3]], y));
    if (!panel) return;
    const stop = panel.curves.length && panel.x && panel.y ? nearest(this.stops, panel, x, y) : null;
    if (stop) {
      this.read(stop);
      return;
    }
    const at = [panel.x && `${panel.x.label}: ${formatted(xValue(panel, x))}`,
      panel.y && `${panel.y.label}: ${formatted(yValue(panel, y))}`].filter(Boolean);
    if (at.length) this.values.textContent = at.join("; ");
  }

  // Enlarge by a factor, or reset with 0; the middle stays where it is.
  enlarge(factor) {
    const { plate, holder } = this;
    const middle = [(plate.scrollLeft + plate.clientWidth / 2) / plate.scrollWidth,
      (plate.scrollTop + plate.clientHeight / 2) / plate.scrollHeight];
    if (this.zoom === 1) {
      this.width = holder.offsetWidth;
      this.height = plate.offsetHeight;
    }
    this.zoom = factor ? Math.min(LARGEST_ZOOM, Math.max(1, this.zoom * factor)) : 1;
    if (this.zoom < 1.01) this.zoom = 1;
    const larger = this.zoom > 1;
    plate.style.height = larger ? `${this.height}px` : "";
    holder.style.width = larger ? `${this.zoom * this.width}px` : "";
    holder.style.maxWidth = larger ? "none" : "";
    plate.scrollLeft = middle[0] * plate.scrollWidth - plate.clientWidth / 2;
    plate.scrollTop = middle[1] * plate.scrollHeight - plate.clientHeight / 2;
    this.percent.textContent = `${Math.round(100 * this.zoom)} %`;
  }
}

// The choice of experiments, channels and curves.

function choice(figures) {
  const status = element("p", { className: "values" });
  status.setAttribute("role", "status");
  const curves = figures.flatMap((figure) => figure.curves), boxes = {};
  const update = () => {
    for (const field of Object.keys(boxes)) {
      hidden[field] = new Set(boxes[field].filter((box) => !box.checked).map((box) => box.value));
    }
    figures.forEach((figure) => figure.update());
    tell();
  };
  const tell = () => {
    const counts = Object.keys(boxes).map((field) => {
      const every = boxes[field].length;
      return `${every - hidden[field].size} of ${every} ${FIELDS[field].toLowerCase()}`;
    });
    status.textContent = `Shown: ${counts.join(", ")}`;
  };
  const panel = element("div", { className: "choice" });
  for (const [field, title] of Object.entries(FIELDS)) {
    const order = new Intl.Collator("en", { numeric: true }).compare;
    const names = [...new Set(curves.map((curve) => curve[field]))].sort(order);
    if (names.length < 2) continue;
    boxes[field] = names.map((name) => element("input", { type: "checkbox", value: name, checked: true }));
    const set = (text, checked) => element("button", { type: "button", textContent: text, onclick: () => {
      boxes[field].forEach((box) => { box.checked = checked; });
      update();
    } });
    const labels = boxes[field].map((box) => element("label", {}, box, ` ${box.value}`));
    const both = names.length < SEVERAL ? [] : [set("All", true), set("None", false)];
    const group = element("fieldset", {}, element("legend", { textContent: title }),
      element("div", { className: "names" }, ...both, ...labels));
    const summary = element("summary", { textContent: `Choose of ${names.length} ${title.toLowerCase()}` });
    panel.append(names.length < MANY ? group : element("details", {}, summary, group));
  }
  panel.addEventListener("change", update);
  if (!Object.keys(boxes).length) return;
  tell();
  panel.append(status);
  figures.find((figure) => figure.curves.length).figure.before(panel);
}

choice([...document.querySelectorAll("figure[data-panels]")].map((figure) => new InteractiveFigure(figure)));
