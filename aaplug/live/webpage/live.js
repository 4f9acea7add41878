// What is seen is one state, which gestures and controls change; `frame` asks the server for it, and `draw` shows it.

const stage = at("stage"), canvas = at("picture");
const REST_MS = 80; // ms without a change after which the camera is at rest
const FPS = 24; // of a recorded path
const SHAKE_PX = 0.7, SHAKE_TURNS = [1.1, 0.7]; // px to either side, and turns per second along both axes
const MAX_PICTURE = {side: 8192, pixels: 1 << 25}; // of a picture, as the server bounds it
const TURN_PER_PX = 0.008, NEARER_PER_PX = 0.0015; // of a drag: radians per CSS px; of the wheel: per px
const STEP_BACK = 1.25, MAX_STEPS_BACK = 14; // times the distance with each step, until the cameras are in sight
const ADDRESS_DELAY_MS = 200; // ms without a change before the address follows

let about = null; // the facts about the scene, from the server
const state = {
  scene: "", pose: null, depth: 1, at: null, base: 0, scale: 1, enlarge: true, fov: 50, sides: [], split: 0.5, lens: false, x: 0.5, y: 0.5,
  zoom: 8, frustums: false, fade: 0, paint: null, background: null, shake: false, record: false,
};
const livePicture = {id: 0, stage: "connecting", size: [1, 1], sheets: [sheetOf(1, 1)[0], sheetOf(1, 1)[0]], photo: null, overlay: null, camera: null};
const path = [];

const view = () => about.views[state.at ?? state.base];
const trained = () => about.views[state.base].focal; // px: the focal length that scale 1 has
const tangent = () => Math.tan(state.fov * Math.PI / 360);

function extent() { // size and focal length of the picture that fits the state, in px, and how much it is enlarged
  const density = window.devicePixelRatio || 1, focal = state.scale * (state.at === null ? trained() : view().focal);
  const [width, height] = [stage.clientWidth, stage.clientHeight].map((side) => Math.max(1, Math.floor(side * density)));
  const high = 2 * focal * tangent(), wide = high * width / height;
  let size = [clamp(Math.round(wide), 1, Math.min(width, MAX_PICTURE.side)), clamp(Math.round(high), 1, Math.min(height, MAX_PICTURE.side))];
  const over = Math.sqrt(size[0] * size[1] / MAX_PICTURE.pixels);
  if (over > 1) size = size.map((side) => Math.floor(side / over));
  const times = state.enlarge ? Math.max(1, Math.min(width / size[0], height / size[1])) : 1;
  return {size, focal, times, density};
}

function fitted(one) { // the field of view in degrees that shows all of a view, and the largest scale up to 1 that fits
  const ratio = stage.clientHeight / stage.clientWidth, half = Math.max(one.height, one.width * ratio) / 2 / one.focal;
  const scale = Math.min(1, stage.clientHeight * (window.devicePixelRatio || 1) / (2 * one.focal * half));
  return {fov: Math.min(120, Math.atan(half) * 360 / Math.PI), scale};
}

// ---------------------------------------------------------------------------------------------------------- asking

let link = null, dropped = null, asked = "", moving = false, changed = 0, number = 0, waiting = 0;

function shaken(now) { // the pose, moved by fractions of a pixel
  if (!state.shake) return state.pose;
  const [x, y] = SHAKE_TURNS.map((turns) => SHAKE_PX * Math.sin(now / 1000 * turns * 2 * Math.PI) / extent().focal);
  return looked(state.pose, x, y);
}

function frame(now) { // asks for what has changed, and says when the camera rests
  waiting = 0;
  if (!about || !state.sides.length) return;
  const {size: [width, height], focal} = extent(), {sides, paint, background} = state;
  const wanted = {pose: shaken(now), focal, width, height, sides, paint, background, at: state.shake ? null : state.at, photo: state.at !== null && view().photo};
  const key = JSON.stringify(wanted), fresh = key !== asked;
  if (fresh) changed = now;
  const rests = now - changed > REST_MS && !state.shake;
  if (fresh || (rests && moving)) {
    const id = ++number;
    if (link.send({see: {...wanted, id, split: state.split, moving: !rests}})) {
      asked = key;
      moving = !rests;
    }
  }
  canvas.dataset.asked = number;
  if (state.record) keepFrame(now, wanted);
  if (moving || state.shake || state.record) wake();
}

function wake() {
  if (!waiting) waiting = requestAnimationFrame(frame);
}

function change(parts) {
  if (parts.pose && !("at" in parts)) parts = {...parts, at: null};
  Object.assign(state, parts);
  bound(state);
  canvas.dataset.asked = "soon";
  controls();
  draw();
  wake();
  clearTimeout(change.waiting);
  change.waiting = setTimeout(() => history.replaceState(null, "", address()), ADDRESS_DELAY_MS);
}

function standIn(index) { // at a camera of the data set, all of its picture in sight
  const one = about.views[index], {fov, scale} = fitted(one);
  const fits = state.pose ? state.scale : scale;
  change({pose: one.pose, at: index, base: index, depth: state.pose ? state.depth : about.depth, fov, scale: fits});
}

function stepBack() { // so far that most of the cameras are in sight: at a pose of its own a camera cannot be seen
  const inSight = (pose) => camerasIn(about.views, pose, extent().focal, extent().size, state.depth)
    .filter(({points: [eye]}) => eye.every((x) => x > 0 && x < 1)).length;
  const wanted = Math.min(about.views.length - 1, Math.ceil(about.views.length / 2));
  const steps = Array.from({length: MAX_STEPS_BACK}, (_, i) => dollied(state, STEP_BACK ** i));
  const next = steps.find(({pose}) => inSight(pose) >= wanted) || steps.at(-1);
  change({frustums: true, ...(next.pose === state.pose || inSight(state.pose) >= wanted ? {} : next)});
}

function turnAbout({picked: [x, y], depth}) { // moves the camera so that what was picked is in the middle, and turns about it
  if (depth === null) return say("nothing is there to turn about");
  const {size: [width, height], focal} = extent();
  const beside = panned({pose: state.pose, depth}, (x - 0.5) * width / focal, (y - 0.5) * height / focal);
  change({pose: beside.pose, depth});
}

function keepFrame(now, {pose, focal, height}) {
  if (path.length && now - path.at(-1).time < 1000 / FPS - 4) return;
  path.push({time: now, camera_to_world: worldFromCamera(pose), fov: Math.atan(height / 2 / focal) * 360 / Math.PI});
  at("path").textContent = `Save path (${path.length})`;
}

// --------------------------------------------------------------------------------------------------------- showing

const STAGES = {connecting: "connecting", moving: "moving", refining: "refining", complete: "refining", done: "at rest"};

function receive(header, bitmaps) {
  const problem = header.problem || header.refused;
  if (problem) {
    at("status").dataset.stage = "problem";
    at("status").lastElementChild.textContent = problem;
    return say(problem);
  }
  if (header.still) return download(bitmaps[0], header.still);
  if (header.take) return link.sendFile(dropped);
  if (header.picked) return turnAbout(header);
  if (String(header.size) !== String(livePicture.size)) {
    livePicture.sheets = livePicture.sheets.map(() => sheetOf(...header.size)[0]);
    livePicture.size = header.size;
  }
  const settled = header.stage === "done";
  if (!settled) livePicture.photo = livePicture.overlay = null;
  else if (!header.parts.some(({of}) => of === "paint")) livePicture.overlay = null;
  header.parts.forEach(({of, span: [left, right]}, i) => {
    if (of === "photo") livePicture.photo = {bitmap: bitmaps[i], box: [left, header.rows[0], right - left, header.rows[1] - header.rows[0]]};
    else if (of === "paint") livePicture.overlay = paintSheet(bitmaps[i], header.legend);
    else livePicture.sheets[of].getContext("2d").drawImage(bitmaps[i], left, 0, right - left, header.size[1]);
  });
  Object.assign(livePicture, {id: header.id, stage: header.stage, psnr: header.psnr, whole: header.whole, camera: header.camera || null});
  status(header);
  draw();
}

function status({stage: now, ms, samples, scale, gaussians}) {
  const words = [STAGES[now], `${ms.toFixed(0)} ms`];
  const grids = [...new Set(samples)].map((n) => `${n}×${n}`);
  words.push(`${grids.join(" and ")} sample${grids.join() === "1×1" ? "" : "s"} a pixel`);
  if (scale < 1) words.push(`at ${(100 * scale).toFixed(0)} % of the resolution`);
  if (gaussians && gaussians < about.gaussians) words.push(`${Math.round(gaussians / 1000)}k Gaussians`);
  at("status").dataset.stage = now;
  at("status").lastElementChild.textContent = words.join(" · ");
}

let cameras = [], hovered = null, pointer = null;

function draw() {
  if (!about) return;
  const [width, height] = livePicture.size, {times, density} = extent(), box = lensBox(state, height / width);
  canvas.width = Math.round(width * times); canvas.height = Math.round(height * times);
  canvas.style.width = `${canvas.width / density}px`; canvas.style.height = `${canvas.height / density}px`;
  drawWhole(canvas, livePicture.sheets, state.split);
  const ink = canvas.getContext("2d");
  ink.imageSmoothingEnabled = false;
  if (livePicture.photo && state.fade > 0) {
    ink.globalAlpha = state.fade;
    ink.drawImage(livePicture.photo.bitmap, ...livePicture.photo.box.map((x) => x * times));
    ink.globalAlpha = 1;
  }
  if (livePicture.overlay) ink.drawImage(livePicture.overlay.sheet, 0, 0, canvas.width, canvas.height);
  if (state.frustums) {
    cameras = camerasIn(about.views, state.pose, extent().focal, livePicture.size, state.depth);
    drawCameras(canvas, cameras, hovered);
  }
  labels(); // they show the crops, which have no size before
  if (state.lens) {
    drawBox(canvas, box);
    drawCrops(box);
  }
  figures();
}

function drawCrops(box) {
  [...at("crops").children].forEach((figure, i) => {
    const [crop, caption] = figure.children, side = Math.round(crop.clientWidth * (window.devicePixelRatio || 1));
    crop.width = crop.height = side;
    drawCrop(crop, livePicture.sheets[i], box);
    caption.textContent = nameOf(i);
  });
}

const takesQuality = (recipe) => recipe === "auto";
const nameOf = (i) => {
  const {recipe, quality} = state.sides[i];
  return takesQuality(recipe) ? `${recipe} · ${quality}` : recipe;
};

function labels() {
  const faded = livePicture.photo && state.fade === 1; // the photograph hides both sides
  at("name-0").textContent = faded ? "photograph" : state.split > 0 ? nameOf(0) : "";
  at("name-1").textContent = !faded && state.split < 1 ? nameOf(1) : "";
  at("crops").hidden = !state.lens;
  const {start} = about;
  at("hint").hidden = !start || state.at !== start.view || state.scale !== start.scale || state.lens || livePicture.overlay;
  at("legend").hidden = !livePicture.overlay;
  if (!livePicture.overlay) return;
  drawLegend(at("legend"), livePicture.overlay.legend);
  const value = pointer && valueUnder(livePicture.overlay, pointer.x, pointer.y);
  at("legend").querySelector("output").textContent = value ? `here: ${value}` : "";
}

function figures() { // for whoever reads the page by machine, and the photograph's figures
  const {psnr, whole} = livePicture.stage === "done" ? livePicture : {};
  const values = psnr && psnr.map((value, i) => `${nameOf(i)}: ${value === null ? "equal" : `${value.toFixed(2)} dB`}`);
  const none = psnr === null ? "no PSNR above the photograph's own size" : "";
  at("psnr").textContent = values ? `${values.join("\n")}${whole ? "" : "\n(of what is seen)"}` : none;
  Object.assign(canvas.dataset, {
    id: livePicture.id, stage: livePicture.stage, size: livePicture.size.join("x"), split: state.split.toFixed(3), lens: state.lens ? lensText(state) : "off",
    at: state.at ?? "", scale: state.scale, paint: livePicture.overlay ? state.paint : "", psnr: psnr ? psnr.join() : "",
  });
  canvas.setAttribute("aria-label", `${nameOf(0)} left of ${(100 * state.split).toFixed(0)} % of the width, ${nameOf(1)} right`);
}
