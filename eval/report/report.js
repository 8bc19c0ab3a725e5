"use strict";
// Draws the charts of the page, and makes their controls work. All colours come from style.css.
(async () => {
  const root = document.documentElement;
  const touch = matchMedia("(pointer: coarse)").matches; // dragging scrolls the page there

  async function unpack(element) {
    const bytes = Uint8Array.from(atob(element.textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    element.remove();
    return new Response(stream).text();
  }

  // Colours

  const probe = document.body.appendChild(document.createElement("i"));
  probe.hidden = true;

  function colour(name) {
    probe.style.color = `var(${name})`;
    return getComputedStyle(probe).color;
  }

  function coloured(value) {
    if (typeof value === "string") return value.startsWith("--") ? colour(value) : value;
    if (Array.isArray(value)) return value.map(coloured);
    if (value === null || typeof value !== "object" || "bdata" in value) return value;
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, coloured(item)]));
  }

  // Charts

  // An axis makes room on its own side only. Room for the labels at its ends moves those labels, which may
  // then need none: it would never come to rest.
  function axis(own, automargin) {
    return {
      automargin, gridcolor: "--rule", linecolor: "--rule", zeroline: false, ticks: "outside",
      ticklen: 4, tickcolor: "--rule", ...own, title: { standoff: 8, font: { size: 13 }, ...own.title },
    };
  }

  function zoomed(chart, name) {
    const { range, autorange } = chart.plot.layout?.[name] ?? { autorange: true };
    return autorange === false ? { range, autorange } : {};
  }

  function layout(chart) {
    const { xaxis, yaxis, ...own } = chart.layout;
    return coloured({
      showlegend: false, dragmode: chart.dragmode,
      margin: { l: 8, r: 8, t: 8, b: 8 }, paper_bgcolor: "--surface", plot_bgcolor: "--surface",
      font: { family: getComputedStyle(document.body).fontFamily, size: 12, color: "--ink" },
      hoverlabel: { bgcolor: "--raised", bordercolor: "--rule", font: { color: "--ink" } },
      xaxis: { ...axis(xaxis, "height"), ...zoomed(chart, "xaxis") },
      yaxis: { ...axis(yaxis, "width"), ...zoomed(chart, "yaxis") },
      ...own,
    });
  }

  const config = { displayModeBar: false, doubleClick: "reset", scrollZoom: true };

  function paint(chart) {
    const traces = coloured(chart.data).map((trace, i) => ({ ...trace, visible: chart.visible[i] }));
    const { width, height } = chart.plot.getBoundingClientRect();
    return Plotly.react(chart.plot, traces, { ...layout(chart), width, height }, config);
  }

  function zoom(chart, factor, right = 0, up = 0) {
    const update = {};
    for (const [name, shift] of [["xaxis", right], ["yaxis", up]]) {
      const [low, high] = chart.plot.layout[name].range;
      const centre = (low + high) / 2 + shift * (high - low);
      const half = (factor * (high - low)) / 2;
      update[`${name}.range`] = [centre - half, centre + half];
    }
    return Plotly.relayout(chart.plot, update);
  }

  const actions = {
    in: (chart) => zoom(chart, 0.5),
    out: (chart) => zoom(chart, 2),
    reset: (chart) => Plotly.relayout(chart.plot, { "xaxis.autorange": true, "yaxis.autorange": true }),
    save: (chart) =>
      Plotly.downloadImage(chart.plot, { format: "png", scale: 2, filename: chart.title.replace(/\W+/g, "_") }),
    drag(chart, button) {
      const moves = chart.dragmode !== "pan";
      chart.dragmode = moves ? "pan" : touch ? false : "zoom";
      button.setAttribute("aria-pressed", moves);
      return Plotly.relayout(chart.plot, { dragmode: chart.dragmode });
    },
  };

  const keys = {
    "+": (chart) => zoom(chart, 0.5), "-": (chart) => zoom(chart, 2), 0: actions.reset,
    ArrowLeft: (chart) => zoom(chart, 1, -0.2), ArrowRight: (chart) => zoom(chart, 1, 0.2),
    ArrowUp: (chart) => zoom(chart, 1, 0, 0.2), ArrowDown: (chart) => zoom(chart, 1, 0, -0.2),
  };

  function control(chart, figure) {
    for (const button of figure.querySelectorAll("[data-act]"))
      button.addEventListener("click", () => actions[button.dataset.act](chart, button));
    const named = chart.data.flatMap((trace, i) => ("name" in trace ? [i] : []));
    for (const button of figure.querySelectorAll("[data-name]"))
      button.addEventListener("click", () => {
        const trace = named[button.dataset.name];
        chart.visible[trace] = !chart.visible[trace];
        button.setAttribute("aria-pressed", chart.visible[trace]);
        paint(chart);
      });
    chart.plot.addEventListener("keydown", (event) => {
      if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key](chart);
    });
    // The wheel scrolls the page; with Ctrl, which pinching a touchpad implies, it zooms.
    chart.plot.addEventListener("wheel", (event) => event.ctrlKey || event.stopPropagation(), { capture: true });
  }

  async function open(figure) {
    const { data, layout } = JSON.parse(await unpack(figure.querySelector("script")));
    const title = figure.querySelector("h4").textContent;
    const plot = figure.querySelector(".plot");
    const chart = { data, layout, title, plot, visible: data.map(() => true), dragmode: touch ? false : "zoom" };
    await paint(chart);
    control(chart, figure);
    return chart;
  }

  // Theme, paper and width

  const charts = [];
  const repaint = () => charts.forEach(paint);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const print = matchMedia("print");
  const button = document.getElementById("theme");
  let chosen = null;

  function setTheme() {
    const isDark = chosen ?? dark.matches;
    root.style.colorScheme = isDark ? "dark" : "light";
    button.textContent = isDark ? "Light" : "Dark";
    repaint();
  }

  function setPaper(isPaper) {
    root.toggleAttribute("data-paper", isPaper);
    repaint();
  }

  button.addEventListener("click", () => {
    chosen = !(chosen ?? dark.matches);
    setTheme();
  });
  dark.addEventListener("change", setTheme);
  addEventListener("beforeprint", () => setPaper(true));
  addEventListener("afterprint", () => setPaper(false));
  print.addEventListener("change", () => setPaper(print.matches));
  let waiting;
  addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(repaint, 100);
  });

  setTheme();
  const library = document.createElement("script");
  library.textContent = await unpack(document.getElementById("plotly"));
  document.head.append(library);
  for (const figure of document.querySelectorAll(".drawing")) charts.push(await open(figure));
  root.dataset.ready = "";
})();
