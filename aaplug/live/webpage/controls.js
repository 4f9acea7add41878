// Controls: what buttons, lists, keys, pointers and the address do to the state.

const VIEW_FILE = "view.json"; // the camera of the copied command
const EIGHTHS = [1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8];
const scaleName = (scale) => scale < 1 && Number.isInteger(1 / scale) ? `1/${1 / scale}` : `${+scale.toFixed(2)}`;
const say = (text) => { at("said").textContent = text; };
const listed = (id, names, texts = names) => at(id).replaceChildren(...names.map((name, i) => new Option(texts[i], name)));

function controls() { // show the state
  const {size} = extent();
  state.sides.forEach(({recipe, quality}, i) => {
    at(`recipe-${i}`).value = recipe; at(`quality-${i}`).value = quality;
    at(`quality-${i}`).disabled = !takesQuality(recipe);
  });
  at("split").value = 100 * state.split;
  at("scale").value = Math.log2(state.scale);
  at("size").textContent = `${scaleName(state.scale)} × training · ${size.join("×")} px`;
  for (const radio of document.getElementsByName("size")) radio.checked = Number(radio.value) === state.scale;
  for (const radio of document.getElementsByName("enlarge")) radio.checked = (radio.value === "yes") === state.enlarge;
  at("fov").value = state.fov; at("distance").value = Math.log2(state.depth / about.depth);
  for (const name of ["lens", "shake", "frustums", "record"]) at(name).checked = state[name];
  at("zoom").textContent = `${state.zoom}×`;
  at("paint").value = state.paint || "";
  at("background").value = state.background || about.background;
  at("asTrained").disabled = state.background === null;
  at("view").value = state.at === null ? "" : String(state.at);
  at("fade").value = state.fade;
  const texts = {scale: scaleName(state.scale), fov: `${+state.fov.toPrecision(3)}°`, distance: `${+(state.depth / about.depth).toPrecision(3)}×`};
  for (const [id, text] of Object.entries(texts)) { at(id).setAttribute("aria-valuetext", text); at(id).title = text; }
  at("fading").hidden = state.at === null || !view().photo;
  at("path").disabled = !path.length;
}

const flip = () => change({split: state.split > 0.5 ? 0 : 1});
const stepCamera = (by) => standIn(((state.at ?? (by > 0 ? -1 : 0)) + by + about.views.length) % about.views.length);

// ----------------------------------------------------------------------------------------------------- from the server

function hello(facts) {
  const first = about === null, shown = JSON.stringify([about?.title, about?.gaussians, about?.views]);
  const same = shown === JSON.stringify([facts.title, facts.gaussians, facts.views]); // it was lost, or dropped again
  about = facts;
  at("lost").hidden = true;
  asked = "";
  if (same) return wake();
  Object.assign(state, {scene: `${facts.title}, ${facts.gaussians}`, background: null, paint: null, record: false});
  path.length = 0; // it was recorded in another scene
  at("path").textContent = "Save path";
  document.title = `${facts.title} · aaplug`;
  at("title").textContent = facts.title;
  const kernels = facts.rasterizer === "compiled" ? "" : `, rasterizer ${facts.rasterizer}: \`aaplug warmup\` makes it faster`;
  at("facts").textContent = `${facts.gaussians.toLocaleString("en")} Gaussian${facts.gaussians === 1 ? "" : "s"}${facts.assumed ? ", training rate assumed" : ""}${kernels}`;
  for (const i of [0, 1]) {
    listed(`recipe-${i}`, facts.recipes.map(({name}) => name));
    listed(`quality-${i}`, facts.qualities);
  }
  listed("paint", ["", ...Object.keys(facts.paints)], ["nothing", ...Object.values(facts.paints)]);
  listCameras(facts);
  at("cameras").textContent = facts.assumed ? "Views" : "Cameras";
  toggles("scales", "radio", "size", EIGHTHS, scaleName);
  state.sides = facts.sides;
  home();
  if (first) fromAddress();
  else say(`opened ${facts.title}`);
}

function listCameras({views, assumed}) { // by kind: a test camera may have the name of a training camera
  const groups = (assumed ? ["orbit", "assumed training"] : ["test", "training"]).map((label, i) => {
    const group = Object.assign(document.createElement("optgroup"), {label});
    group.append(...views.flatMap(({name, training}, index) => training === (i === 1) ? [new Option(name, index)] : []));
    return group;
  });
  at("view").replaceChildren(new Option("–", ""), ...groups.filter((group) => group.children.length));
}

function home() { // where both sides differ most, or the first view as large as it fits
  const {start} = about;
  state.pose = null;
  standIn(start ? start.view : 0);
  if (!start) return;
  change({scale: start.scale});
  at("hint").textContent = `Left and right differ most here, at ${scaleName(start.scale)}: ${start.decibels.toFixed(1)} dB. Drag the divider across thin parts and edges.`;
}

// ------------------------------------------------------------------------------------------------------- the controls

at("panel").addEventListener("input", ({target: {id, name, value, checked}}) => {
  const [word, side] = id.split("-");
  if (side) change({sides: state.sides.map((one, i) => i === Number(side) ? {...one, [word]: value} : one)});
  else if (name === "size") change({scale: Number(value)});
  else if (name === "enlarge") change({enlarge: value === "yes"});
  else if (id === "split") change({split: value / 100});
  else if (id === "scale") change({scale: 2 ** (Math.abs(value - Math.round(value)) < 0.06 ? Math.round(value) : value)});
  else if (id === "fov") change({fov: Number(value)});
  else if (id === "distance") change(dollied(state, about.depth * 2 ** value / state.depth));
  else if (id === "fade") change({fade: Number(value)});
  else if (id === "paint") change({paint: value || null});
  else if (id === "background") change({background: value});
  else if (id === "frustums" && checked) stepBack();
  else if (id === "view" && value) standIn(Number(value));
  else if (id === "record") { if (checked) path.length = 0; change({record: checked}); }
  else if (["lens", "shake", "frustums"].includes(id)) change({[id]: checked});
});
const clicks = {
  flip, half: () => change({split: 0.5}), weaker: () => change({lens: true, zoom: state.zoom / 2}),
  stronger: () => change({lens: true, zoom: state.zoom * 2}), previous: () => stepCamera(-1), next: () => stepCamera(1),
  path: () => savePath(path, "camera_path.json"), still: saveStill, command: copyCommand, fold, full: fullScreen, asTrained: () => change({background: null}),
};
for (const [id, act] of Object.entries(clicks)) at(id).addEventListener("click", act);

function fold() {
  const folded = document.body.classList.toggle("folded");
  at("fold").setAttribute("aria-expanded", String(!folded));
}

at("full").hidden = !document.fullscreenEnabled; // phones may show no page so
function fullScreen() {
  if (!document.fullscreenEnabled) return;
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen().catch((error) => say(error.message));
}

// ------------------------------------------------------------------------------------------------------------ keeping

function download(file, name) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(file); anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 60_000);
  say(`saved ${name}`);
}

function savePath(frames, name) {
  const [width, height] = extent().size;
  const cameras = frames.map(({time, ...frame}) => ({...frame, aspect: width / height}));
  const text = JSON.stringify({camera_type: "perspective", render_width: width, render_height: height, fps: FPS, seconds: frames.length / FPS, camera_path: cameras});
  download(new Blob([text], {type: "application/json"}), name);
}

const sideSeen = () => state.split < 1 ? 1 : 0; // the right one, while some of it shows

function saveStill() {
  const [width, height] = ["width", "height"].map((id) => Number(at(id).value) || at(id).value);
  if (link.send({still: {width, height, side: sideSeen()}})) say("rendering the picture");
}

function commandLine() { // what renders a side as it is seen, by the camera in VIEW_FILE
  const {recipe, quality} = state.sides[sideSeen()];
  const how = ["--recipe", recipe, ...(takesQuality(recipe) ? ["--quality", quality] : [])];
  const colour = state.background ? ["--background", `"${state.background}"`] : []; // to all shells # begins a remark
  return ["aaplug render", about.words, ...colour, "--path", VIEW_FILE, ...how, "-o", "view.png"].join(" ");
}

async function copyCommand() { // and save the camera that it names
  const {id, stage: now, camera, size: [, height]} = livePicture;
  if (now !== "done" || id !== number) return say("wait until the picture is at rest");
  const fov = Math.atan(height / 2 / camera.fl_y) * 360 / Math.PI, words = commandLine();
  savePath([{camera_to_world: worldFromCamera(state.pose), fov, ...camera}], VIEW_FILE);
  const what = `where ${VIEW_FILE} is saved, run: ${words}`;
  try {
    await navigator.clipboard.writeText(words); // there is none at http addresses of other machines
    say(`copied; ${what}`);
  } catch { say(what); }
}

// --------------------------------------------------------------------------------------------------------------- keys

const KEY_STEPS = { // what a held key does in each step
  ArrowLeft: () => turned(state, 0.04, 0, about.up), ArrowRight: () => turned(state, -0.04, 0, about.up),
  ArrowUp: () => turned(state, 0, 0.04, about.up), ArrowDown: () => turned(state, 0, -0.04, about.up),
  w: () => dollied(state, 0.95), s: () => dollied(state, 1 / 0.95),
  a: () => panned(state, -0.03, 0), d: () => panned(state, 0.03, 0), q: () => panned(state, 0, 0.03), e: () => panned(state, 0, -0.03),
};
const KEY_ACTIONS = {
  f: flip, m: () => change({split: 0.5}), g: fullScreen, x: () => change({shake: !state.shake}), c: () => state.frustums ? change({frustums: false}) : stepBack(),
  r: () => at("record").click(), p: () => change({fade: state.fade > 0 ? 0 : 1}), h: fold, Home: home,
  ",": () => stepCamera(-1), ".": () => stepCamera(1),
};
EIGHTHS.forEach((scale, i) => { KEY_ACTIONS[i + 1] = () => change({scale}); });

window.addEventListener("keydown", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, {target} = event;
  if (event.ctrlKey || event.metaKey || event.altKey || !about || target.matches("select, input[inputmode]")) return;
  if (key.length > 1 && target.matches("input[type=range], input[type=radio]")) return; // arrows are theirs
  const changes = {...(state.lens ? lensMoves(event, state) : {}), ...shortcuts(state)};
  if (key in changes) change(changes[key]);
  else if (key in KEY_STEPS) change(KEY_STEPS[key]());
  else if (key in KEY_ACTIONS) KEY_ACTIONS[key]();
  else return;
  event.preventDefault();
});

// ----------------------------------------------------------------------------------------------------------- pointers

const pointers = new Map(); // those that are down
let grabbed = null, travelled = 0; // what a press moves: "split", "turn" or "move"; CSS px since it began

const over = (event) => place({target: canvas, clientX: event.clientX, clientY: event.clientY});
const nearDivider = (event) => atDivider({target: canvas, clientX: event.clientX, clientY: event.clientY}, state);

stage.addEventListener("pointerdown", (event) => {
  if (!about || event.target.closest("button")) return;
  canvas.focus({preventScroll: true});
  pointers.set(event.pointerId, event);
  try { stage.setPointerCapture(event.pointerId); } catch { /* it is up already */ }
  grabbed = nearDivider(event) && event.button === 0 ? "split" : event.button || event.shiftKey ? "move" : "turn";
  travelled = 0;
  canvas.classList.toggle("turning", grabbed !== "split");
});

stage.addEventListener("pointermove", (event) => {
  if (!about) return;
  pointer = over(event);
  const before = pointers.get(event.pointerId);
  if (!before) return hover(event);
  const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
  travelled += Math.hypot(dx, dy);
  if (pointers.size === 2) pinch(before, event);
  else if (grabbed === "split") change({split: pointer.x});
  else if (grabbed === "turn") change(turned(state, -dx * TURN_PER_PX, -dy * TURN_PER_PX, about.up));
  else shift(dx, dy);
  pointers.set(event.pointerId, event);
});

function hover(event) {
  canvas.style.cursor = nearDivider(event) ? "ew-resize" : "";
  const box = canvas.getBoundingClientRect(), index = state.frustums ? cameraNear(cameras, pointer.x, pointer.y, box) : null;
  if (index !== null) canvas.style.cursor = "pointer";
  const redraws = index !== hovered || livePicture.overlay;
  hovered = index;
  if (state.lens && pointer.x >= 0 && pointer.x <= 1) change({x: pointer.x, y: pointer.y});
  else if (redraws) draw();
}

function shift(dx, dy) { // what is in front follows the pointer
  const {focal, times, density} = extent(), by = density / times / focal;
  change(panned(state, -dx * by, -dy * by));
}

function pinch(before, event) { // two fingers: their middle moves the scene, their distance the camera
  const [other] = [...pointers.values()].filter(({pointerId}) => pointerId !== event.pointerId);
  const apart = (one) => Math.max(8, Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY));
  shift((event.clientX - before.clientX) / 2, (event.clientY - before.clientY) / 2);
  change(dollied(state, apart(before) / apart(event)));
}

function released(event) {
  const tapped = pointers.delete(event.pointerId) && travelled < 5 && event.type === "pointerup";
  canvas.classList.remove("turning");
  if (!tapped || grabbed === "split") return;
  const {x, y} = over(event);
  const index = state.frustums ? cameraNear(cameras, x, y, canvas.getBoundingClientRect()) : null;
  if (index !== null) standIn(index);
  else if (state.lens) change({x, y});
}
stage.addEventListener("pointerup", released);
stage.addEventListener("pointercancel", released);
stage.addEventListener("pointerleave", () => { pointer = null; });
stage.addEventListener("dblclick", (event) => {
  if (!about || event.target.closest("button")) return;
  if (nearDivider(event)) return change({split: 0.5});
  const {x, y} = over(event);
  if (Math.min(x, y, 1 - x, 1 - y) >= 0) link.send({pick: {x, y}});
});
stage.addEventListener("contextmenu", (event) => event.preventDefault());
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => { // a scene file is opened
  event.preventDefault();
  [dropped] = event.dataTransfer.files;
  if (dropped && link.send({open: {name: dropped.name, size: dropped.size}})) say(`sending ${dropped.name}`);
});
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (about) change(dollied(state, Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -400, 400) * NEARER_PER_PX)));
}, {passive: false});
new ResizeObserver(() => { if (about) { controls(); draw(); wake(); } }).observe(stage);

// -------------------------------------------------------------------------------------------------------- the address

const ADDRESS_FIELDS = ["scene", "pose", "depth", "at", "base", "scale", "enlarge", "fov", "sides", "split", "lens", "x", "y", "zoom", "frustums", "fade", "paint", "background"];

function address() {
  return `#${encodeURIComponent(JSON.stringify(Object.fromEntries(ADDRESS_FIELDS.map((name) => [name, state[name]]))))}`;
}

function fromAddress() { // the state that the address names, where it can be one
  try {
    const fields = JSON.parse(decodeURIComponent(location.hash.slice(1)));
    const isView = (index) => Number.isInteger(index) && index >= 0 && index < about.views.length;
    const numbers = ["depth", "scale", "fov", "split", "x", "y", "zoom", "fade"].every((name) => Number.isFinite(fields[name]));
    const sides = fields.sides.every(({recipe, quality}) => about.recipes.some(({name}) => name === recipe) && about.qualities.includes(quality));
    if (fields.scene !== state.scene || !numbers || !sides || fields.sides.length !== 2 || !isView(fields.base) || (fields.at !== null && !isView(fields.at))) return;
    if (fields.pose.length !== 16 || !fields.pose.every(Number.isFinite) || !(fields.scale > 0 && fields.depth > 0)) return;
    if (fields.paint !== null && !(fields.paint in about.paints)) return;
    fields.background = /^#[0-9a-f]{6}$/.test(fields.background) ? fields.background : null;
    change({...Object.fromEntries(ADDRESS_FIELDS.map((name) => [name, fields[name]])), scale: clamp(fields.scale, 1 / 8, 8)});
  } catch { /* nothing, or nothing of ours */ }
}

link = linked({hello, message: receive, lost: () => {
  at("lost").textContent = "The connection is lost. Trying again…";
  at("lost").hidden = about === null;
  at("status").dataset.stage = "connecting";
  at("status").lastElementChild.textContent = "connecting";
}});
