"use strict";
(() => {
  // Paper shows what is folded away on the screen.
  const folded = () => [...document.querySelectorAll("details:not([open])")];
  let opened = [];
  window.addEventListener("beforeprint", () => { opened = folded(); opened.forEach((one) => { one.open = true; }); });
  window.addEventListener("afterprint", () => { opened.forEach((one) => { one.open = false; }); });

  const embedded = document.getElementById("chart-data");
  if (!embedded) return;
  const { bokeh, data } = JSON.parse(embedded.textContent);
  const select = document.getElementById("particle");
  const facts = document.getElementById("particle-facts");
  const button = (id, act) => document.getElementById(id).addEventListener("click", act);
  let model;
  let home;

  const difference = (one, other) => one.map((value, i) => (value === null || other[i] === null ? null : value - other[i]));
  const missing = (column) => column.map(() => null);

  function ends(columns) {
    let low = Infinity;
    let high = -Infinity;
    for (const column of columns) for (const value of column) if (value !== null) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (!(high >= low)) return [-1, 1];
    const margin = 0.05 * (high - low) || 0.05 * Math.abs(high) || 1;
    return [low - margin, high + margin];
  }

  // One closed outline for every stretch of one kind: along one end of the band and back along the other.
  function outlines(one) {
    const found = { displacement: [], force: [], time: [], away: [] };
    if (!one.low) return found;
    let stretch = [];
    const close = () => {
      if (stretch.length > 1) {
        const there = (order, column) => order.map((i) => column[i]);
        const round = (order, low, high) => [...there(order, low), ...there([...order].reverse(), high)];
        // Noise of force must not fold the band.
        const along = [...stretch].sort((i, j) => one.force[i] - one.force[j]);
        found.displacement.push(round(along, one.low, one.high));
        found.force.push(round(along, one.force, one.force));
        found.time.push(round(stretch, one.time, one.time));
        found.away.push(one.own
          ? round(stretch, difference(one.low, one.own), difference(one.high, one.own))
          : round(stretch, one.time, one.time).map(() => NaN));
      }
      stretch = [];
    };
    one.force.forEach((_, i) => {
      if (i > 0 && one.kind[i] !== one.kind[i - 1]) close();
      if (one.low[i] === null) close();
      else stretch.push(i);
    });
    close();
    return found;
  }

  const numbers = (column) => column.map((value) => (value === null ? NaN : value));

  function show(index) {
    const one = data.particles[index];
    const looks = one.kind.map((kind) => data.kinds[kind]);
    const residual = one.own ? difference(one.displacement, one.own) : missing(one.force);
    model("points").data = {
      displacement: one.displacement, force: one.force, residual: numbers(residual), time: one.time,
      marker: looks.map((look) => look.marker), colour: looks.map((look) => look.colour),
      alpha: one.used.map((used) => (used ? 0.75 : 0.2)), particle: one.force.map(() => one.label),
      segment: looks.map((look) => look.word), compared: one.used.map((used) => (used ? "yes" : "no")),
    };
    const own = one.own || missing(one.force);
    const typical = one.typical || missing(one.force);
    model("lines").data = { force: one.force, own: numbers(own), typical: numbers(typical) };
    model("bands").data = outlines(one);
    const counted = residual.filter((_, i) => one.used[i]);
    const reach = Math.max(...ends([counted, [0]]).map(Math.abs));
    home = [
      [model("curve"), ends([one.displacement, own]), ends([one.force])],
      [model("residual"), ends([one.time]), [-reach, reach]],
    ];
    reset();
    facts.textContent = one.label + ": " + one.facts;
    document.getElementById("previous").disabled = index === 0;
    document.getElementById("next").disabled = index === data.particles.length - 1;
  }

  const ranges = () => home.flatMap(([plot, across, up]) => [[plot.x_range, across], [plot.y_range, up]]);

  function reset() {
    for (const [range, [start, end]] of ranges()) range.setv({ start, end, reset_start: start, reset_end: end });
  }

  function zoom(factor) {
    for (const [range] of ranges()) {
      const middle = (range.start + range.end) / 2;
      const half = (factor * (range.end - range.start)) / 2;
      range.setv({ start: middle - half, end: middle + half });
    }
  }

  function move(by) {
    const index = Number(select.value) + by;
    if (index < 0 || index >= data.particles.length) return;
    select.value = String(index);
    show(index);
  }

  Bokeh.embed.embed_items(bokeh.docs, bokeh.items).then(() => {
    const page = Bokeh.documents[Bokeh.documents.length - 1];
    model = (name) => page.get_model_by_name(name);
    if (window.matchMedia("(pointer: coarse)").matches) {
      // A finger on the chart must go on scrolling the page: zooming is what the buttons are for.
      for (const name of ["curve", "residual"]) model(name).toolbar.setv({ active_drag: null });
      for (const tool of ["curve", "residual"].flatMap((name) => model(name).toolbar.tools)) if (tool.type === "BoxZoomTool") tool.active = false;
    }
    select.addEventListener("change", () => show(Number(select.value)));
    button("previous", () => move(-1));
    button("next", () => move(1));
    button("zoom-in", () => zoom(0.6));
    button("zoom-out", () => zoom(1 / 0.6));
    button("zoom-reset", reset);
    show(Number(select.value) || 0);
    document.getElementById("interactive").dataset.ready = "yes";
  });
})();
