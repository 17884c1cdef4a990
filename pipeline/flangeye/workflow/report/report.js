(() => {
  "use strict";
  const PAPER_WIDTH = 690; // CSS pixels between the margins of an A4 page
  const plots = [...document.querySelectorAll(".plot")];
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) =>
    getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function template() {
    const [ink, axis, grid] = ["--ink", "--axis", "--grid"].map(colour);
    const flat = { gridcolor: grid, zerolinecolor: axis, linecolor: axis, tickcolor: axis };
    const solid = { gridcolor: axis, zerolinecolor: axis, linecolor: axis, color: axis,
      gridwidth: 0.5, showbackground: false, showspikes: false, tickfont: { size: 11 } };
    return {
      layout: {
        font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: ink },
        paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
        xaxis: flat, yaxis: flat,
        scene: { xaxis: solid, yaxis: solid, zaxis: solid },
        hoverlabel: { bgcolor: colour("--panel"), bordercolor: axis, font: { color: ink } },
        modebar: { bgcolor: "rgba(0,0,0,0)", color: axis, activecolor: ink },
      },
      data: { scatter3d: [{ textfont: { color: axis, size: 14 } }] },
    };
  }

  // The view's height is what plotly.js fits; a narrow plot has to be seen from further away.
  function stepBack(eye, div) {
    const further = Math.max(1, 1.3 * div.clientHeight / div.clientWidth);
    for (const axis of "xyz") eye[axis] *= further;
  }

  function draw(div) {
    const { data, layout } = JSON.parse(document.getElementById(div.dataset.figure).textContent);
    if (div.classList.contains("space")) stepBack(layout.scene.camera.eye, div);
    // Scrolling is for the page; only with Ctrl does the wheel belong to the plot.
    div.addEventListener("wheel", (e) => e.ctrlKey || e.stopPropagation(),
      { capture: true, passive: true });
    return Plotly.newPlot(div, data, { ...layout, template: template(), autosize: true },
      { responsive: true, displaylogo: false });
  }

  // plotly.js is inside the page, packed: a third of its size.
  async function unpackPlotly() {
    const packed = document.getElementById("plotly");
    if (!packed) return;
    const bytes = Uint8Array.from(atob(packed.textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    packed.replaceWith(script);
  }

  async function drawAll() {
    if (plots.length) await unpackPlotly();
    for (const div of plots) {
      await draw(div);
      await new Promise((done) => setTimeout(done)); // let the page answer in between
    }
    document.documentElement.dataset.drawn = plots.length;
  }

  function retheme() {
    for (const div of plots) if (div.layout) Plotly.relayout(div, { template: template() });
  }

  async function copy(button) {
    const text = document.getElementById(button.dataset.copies);
    try {
      await navigator.clipboard.writeText(text.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(text);
      button.textContent = "Press Ctrl+C";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 2000);
  }

  function fitPaper() {
    for (const div of plots) {
      const share = div.closest(".panels") ? 0.3 : 1;
      div.style.setProperty("--on-paper", Math.min(1, share * PAPER_WIDTH / div.clientWidth));
      div.style.setProperty("--on-screen", `${div.clientHeight}px`);
    }
  }

  // A 3D canvas that does not keep what it has drawn comes out of the printer empty.
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return getContext.call(this, kind, { ...options, preserveDrawingBuffer: true });
  };

  for (const button of document.querySelectorAll("[data-copies]"))
    button.addEventListener("click", () => copy(button));
  dark.addEventListener("change", retheme);
  addEventListener("beforeprint", fitPaper);
  drawAll();
})();
