// A camera on an orbit about a scene: drag turns it, the wheel or two fingers zoom.

const HALF_ANGLE = Math.PI / 8; // of the field of view, from the middle of the picture upwards

/** What gives the camera of the next frame, with a vertical field of view of 45 degrees.  view: of settings.json. */
export function orbit(canvas, { up, front, centre, radius }) {
  const side = up.map((_, i) => up[(i + 1) % 3] * front[(i + 2) % 3] - up[(i + 2) % 3] * front[(i + 1) % 3]);
  const fingers = new Map();
  let [turn, tilt, zoom] = [0, 0.35, 1];
  const spread = () => {
    const [first, second] = fingers.values();
    return Math.hypot(first.clientX - second.clientX, first.clientY - second.clientY);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const before = fingers.size === 2 ? spread() : 0;
    fingers.set(event.pointerId, event);
    if (fingers.size === 2) zoom *= before / Math.max(spread(), 1);
    if (fingers.size > 1) return;
    turn -= (event.clientX - last.clientX) / 200;
    tilt = Math.max(-1.55, Math.min(1.55, tilt + (event.clientY - last.clientY) / 200));
  });
  canvas.addEventListener("wheel", (event) => { zoom *= Math.exp(event.deltaY / 1000); }, { passive: true });
  return () => {
    const narrow = Math.atan(Math.tan(HALF_ANGLE) * Math.min(1, canvas.width / canvas.height));
    const distance = (zoom * radius) / Math.sin(narrow);
    const level = front.map((x, i) => Math.cos(turn) * x + Math.sin(turn) * side[i]);
    const eye = centre.map((x, i) => x + distance * (Math.cos(tilt) * level[i] + Math.sin(tilt) * up[i]));
    return { eye, near: distance / 1000, far: 1000 * (distance + radius) };
  };
}
