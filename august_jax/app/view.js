// What pages with turnable views have: packed numbers, colours from low to high, and hands that turn a view.

// ---- numbers: bytes, and 16-bit integers in units of a step ---------------------------------------------------
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
function steps(text, step) {
  const view = new DataView(bytes(text).buffer);
  return Float32Array.from({ length: view.byteLength / 2 }, (_, i) => view.getInt16(2 * i, true) * step);
}

// ---- colours from low to high ---------------------------------------------------------------------------------
const STOPS = @STOPS@;
function ramp(level) {
  const at = Math.min(Math.max(level, 0), 1) * (STOPS.length - 1), low = Math.min(Math.floor(at), STOPS.length - 2);
  const lift = dark.matches ? 0.16 : 0;  // dark purple would be lost on a dark ground
  return STOPS[low].map((value, k) => Math.round((1 - lift) * (value + (at - low) * (STOPS[low + 1][k] - value)) + 255 * lift));
}
function drawRamp(canvas) {
  const pen = canvas.getContext("2d");
  for (let i = 0; i < canvas.width; i++) {
    pen.fillStyle = `rgb(${ramp(i / (canvas.width - 1)).join(",")})`;
    pen.fillRect(i, 0, 1, canvas.height);
  }
}

// ---- hands: a view is { eye: { turn, lift, zoom }, draw, start }, its canvas lies in a .pane -------------------
const TAP_PX = 9, TAP_MS = 450;
function turnable(canvas, view) {
  const fingers = new Map(), pane = canvas.parentElement, { eye, draw } = view;
  let spread = 0, began = null;
  canvas.tabIndex = 0;
  canvas.setAttribute("role", "application");
  canvas.setAttribute("aria-roledescription", "turnable view");
  canvas.setAttribute("aria-describedby", "keys");
  const hint = document.createElement("span");
  hint.className = "hint"; hint.textContent = "held: tap to let go";
  pane.append(hint);
  const turn = (right, down) => {
    eye.turn -= right * 0.008;
    eye.lift = Math.min(1.55, Math.max(-1.55, eye.lift + down * 0.008));
    draw();
  };
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event); spread = 0;
    began = fingers.size === 1 ? event : null;
    if (event.pointerType !== "touch") canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    fingers.set(event.pointerId, event);
    const right = event.clientX - before.clientX, down = event.clientY - before.clientY;
    if (fingers.size === 2) {
      const [a, b] = [...fingers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      turn(right / 2, down / 2);
      if (spread) zoom(now / spread, view);
      spread = now;
    } else {
      turn(right, event.pointerType === "touch" && !pane.classList.contains("held") ? 0 : down);
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    const short = began && event.timeStamp - began.timeStamp < TAP_MS;
    if (event.pointerType === "touch" && short && Math.hypot(event.clientX - began.clientX, event.clientY - began.clientY) < TAP_PX) hold(pane);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => { fingers.delete(event.pointerId); spread = 0; began = null; });
  // the wheel scrolls the page, until the view was clicked or the control key is down
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.0012), view);
  }, { passive: false });
  canvas.addEventListener("dblclick", () => move(view, "reset"));
  canvas.addEventListener("keydown", (event) => {
    const name = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "nearer", "=": "nearer",
      "-": "farther", "0": "reset", Home: "reset" }[event.key];
    if (!name || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    move(view, name);
  });
}
function hold(pane) {
  for (const other of document.querySelectorAll(".pane")) other.classList.toggle("held", other === pane && !other.classList.contains("held"));
}
document.addEventListener("pointerdown", (event) => { if (!event.target.closest(".pane")) hold(null); });
const MOVES = { left: ["turn", -0.12], right: ["turn", 0.12], up: ["lift", 0.12], down: ["lift", -0.12] };
function move(view, name) {
  if (name === "reset") { Object.assign(view.eye, view.start); view.draw(); return; }
  if (!MOVES[name]) { zoom(name === "nearer" ? 1.15 : 1 / 1.15, view); return; }
  const [angle, step] = MOVES[name];
  view.eye[angle] += step;
  view.eye.lift = Math.min(1.55, Math.max(-1.55, view.eye.lift));
  view.draw();
}
function offerTurns(group, view) {
  for (const [name, sign, says] of [["left", "←", "turn left"], ["right", "→", "turn right"], ["up", "↑", "lift"], ["down", "↓", "lower"],
    ["nearer", "+", "nearer"], ["farther", "−", "farther"], ["reset", "↺", "as at first"]]) {
    const button = document.createElement("button");
    button.textContent = sign; button.title = says; button.setAttribute("aria-label", says);
    button.addEventListener("click", () => move(view, name));
    group.append(button);
  }
}
function zoom(factor, { eye, draw }) { eye.zoom = Math.min(6, Math.max(0.4, eye.zoom * factor)); draw(); }
