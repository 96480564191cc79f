"use strict";
// Ties the slider, the charts, the 3D view and the tables together.
(() => {
  const page = JSON.parse(document.getElementById("data").textContent);
  const by = (id) => document.getElementById(id), root = document.documentElement;
  const slider = by("slider"), now = by("now"), play = by("play"), theme = by("theme");

  function paintTheme(dark) {
    root.dataset.theme = dark ? "dark" : "light";
    theme.setAttribute("aria-pressed", String(dark));
    theme.textContent = dark ? "Light" : "Dark";
  }
  const wish = matchMedia("(prefers-color-scheme: dark)");
  paintTheme(wish.matches);

  let zoom = null, ready = false, view = { choose() {}, resize() {} };
  const charts = Charts.build(by("charts"), by("others"), page, { hover: tell, choose, zoomed(range) { zoom = range; remember(); } });
  const t = charts.t, last = t.length - 1;
  if (page.scene) view = Scene.build(by("scene"), page.scene, t);
  const first = page.chosen || 0;  // where the page begins: the end of the flight
  let chosen = first, timer = null;
  slider.max = String(last);

  function words(k) {
    if (!page.states) return `${t[k].toFixed(2)} s`;
    const [gamma, reason, fault] = page.states[k];
    const state = gamma === 1 ? "● used" : (reason === "no_scan" ? "~ " : "✗ ") + reason.replaceAll("_", " ");
    return `scan ${page.scans[k]} · ${t[k].toFixed(2)} s · ${state}` + (fault ? ` · injected: ${fault.replaceAll("_", " ")}` : "");
  }
  function tell(hovered) {
    const k = hovered === null ? chosen : hovered;
    now.textContent = words(k);
    view.choose(k);
  }
  // The zoom and the chosen scan stand in the address, so that a view can be sent to someone else.
  function remember() {
    if (!ready) return;
    const parts = [...(zoom ? ["t=" + zoom.map((v) => +v.toPrecision(8)).join(",")] : []), ...(chosen !== first ? ["row=" + chosen] : [])];
    history.replaceState(null, "", parts.length ? "#" + parts.join("&") : location.pathname + location.search);
  }
  function recall() {
    const said = new URLSearchParams(location.hash.slice(1)), range = (said.get("t") || "").split(",").map(Number), row = Number(said.get("row") ?? NaN);
    if (range.length === 2 && range.every(Number.isFinite)) charts.zoomTo(range[0], range[1]);
    if (Number.isInteger(row) && row >= 0 && row <= last) choose(row);
  }
  function choose(k) {
    chosen = k;
    slider.value = String(k);
    slider.setAttribute("aria-valuetext", words(k));
    charts.choose(k); tell(null); remember();
  }
  function stop() { clearInterval(timer); timer = null; play.textContent = "Play"; play.setAttribute("aria-pressed", "false"); }
  function start() {
    if (chosen === last) choose(0);
    const pace = Math.max(1, Math.round(last / 600));
    timer = setInterval(() => { if (chosen >= last) stop(); else choose(Math.min(chosen + pace, last)); }, 50);
    play.textContent = "Pause"; play.setAttribute("aria-pressed", "true");
  }

  slider.addEventListener("input", () => choose(Number(slider.value)));
  play.addEventListener("click", () => timer === null ? start() : stop());
  by("reset").addEventListener("click", () => charts.reset());
  theme.addEventListener("click", () => { paintTheme(root.dataset.theme !== "dark"); charts.repaint(); });
  wish.addEventListener("change", () => { paintTheme(wish.matches); charts.repaint(); });
  document.addEventListener("click", (event) => {
    const jump = event.target.closest(".jump");
    if (jump) { choose(Number(jump.dataset.scan)); by("charts").scrollIntoView(); slider.focus({ preventScroll: true }); }
  });
  new ResizeObserver(() => { charts.resize(); view.resize(); }).observe(by("charts"));
  addEventListener("beforeprint", () => charts.resize(660, 1));  // CSS pixels between the margins of A4 and of US letter
  addEventListener("afterprint", () => charts.resize());
  for (const folded of document.querySelectorAll("details")) folded.addEventListener("toggle", () => charts.resize());
  choose(first);
  recall();
  ready = true;
  addEventListener("hashchange", recall);
  root.dataset.ready = String(Math.round(performance.now()));
})();
