// The viewer: what is shown is one state, which the controls and the address change and `render` draws.

const gallery = JSON.parse(at("gallery").textContent);
const stage = at("stage"), crops = at("crops"), figure = at("compare");
const BESIDE = 720, BETWEEN = 24; // CSS px: from this width on the crops stand right of the picture, so far away
const CROPS = 0.4, BELOW = 0.6; // of the width: what crops beside have at least, and a row of them below in height
const AROUND = 110, LEAST = 240; // CSS px of the screen's height: taken around the picture; a picture's least height
const QUIET = 200; // ms without a change before the address follows

const order = [...new Set([gallery.truth, gallery.ceiling, ...gallery.recipes])];
const own = gallery.recipes.filter((role) => role !== gallery.ceiling);
const preferred = (name, otherwise) => own.includes(name) ? name : otherwise;
const state = {
  view: gallery.views[0], scale: gallery.scales.at(-1), error: false, split: 0.5,
  shown: [preferred("classic", own[0]), preferred("auto", own.at(-1))],
  lens: false, x: 0.5, y: 0.5, zoom: 8, // the lens's centre, as shares of the picture
};

const nameOf = (role) => role === gallery.truth ? gallery.truthName : role;
const shot = () => gallery.shots.find((s) => s.view === state.view && s.scale === state.scale);
const has = (role) => role in shot().images; // not every scale has a truth
function shown() {
  const chosen = order.filter((role) => state.shown.includes(role) && has(role));
  return chosen.length ? chosen : own.slice(-1);
}

function change(parts) {
  Object.assign(state, parts);
  bound(state);
  render();
  clearTimeout(change.waiting);
  change.waiting = setTimeout(() => history.replaceState(null, "", address()), QUIET);
}

// ------------------------------------------------------------------------------------------------------- the address

function address() {
  const words = new URLSearchParams({view: state.view, scale: state.scale});
  for (const role of shown()) words.append("show", role); // two of them are left and right
  words.append("mode", state.error ? "error" : "image");
  words.append("split", state.split.toFixed(3));
  if (state.lens) words.append("lens", lensText(state));
  return `#${words}`;
}

function fromAddress() { // the state that the address names, if it names one and not a section of the page
  const words = new URLSearchParams(location.hash.slice(1));
  if (!words.has("view")) return false;
  const one = (name, known) => known.includes(words.get(name)) ? words.get(name) : state[name];
  const numbers = (name) => (words.get(name) || "").split(",").map(parseFloat).filter(Number.isFinite);
  const roles = words.getAll("show").filter((role) => order.includes(role));
  const [split = state.split] = numbers("split"), [x = state.x, y = state.y, zoom] = numbers("lens");
  change({
    view: one("view", gallery.views), scale: one("scale", gallery.scales), shown: roles.length ? roles : state.shown,
    error: words.get("mode") === "error", split, x, y, lens: zoom !== undefined, zoom: zoom ?? state.zoom,
  });
  return true;
}

// -------------------------------------------------------------------------------------------------------- the picture

async function pane(role) { // what one side shows, and the words above it
  const {images} = shot(), {uri, score} = images[role], words = [nameOf(role)];
  if (score) words.push(score);
  if (!state.error || !has(gallery.truth)) {
    if (state.error) words.push(`no ${gallery.truthName} at this scale: the image itself`);
    return {sheet: await picture(uri), label: words.join(" · ")};
  }
  const {map, largest} = await errorsAgainst(images[gallery.truth].uri)(uri);
  const same = role === gallery.truth ? "compared with itself: no error" : `equal to the ${gallery.truthName}: no error`;
  words.push(largest ? `largest error ${largest} of 255` : same);
  return {sheet: map, label: words.join(" · ")};
}

async function render() { // decodes what is asked for, then draws
  const mine = render.turn = (render.turn || 0) + 1, chosen = shown();
  const panes = await Promise.all(chosen.map(pane));
  if (mine !== render.turn) return; // asked for something else meanwhile
  controls(chosen);
  draw(panes, shot().height / shot().width);
  stage.setAttribute("aria-label", `${state.view} at scale ${state.scale}: ${panes.map((p) => p.label).join("; ")}`);
  Object.assign(figure.dataset, {
    split: state.split.toFixed(3), lens: state.lens ? lensText(state) : "off",
    shown: [state.view, state.scale, chosen.join("+"), state.error ? "error" : "image"].join("|"),
  });
}

function draw(panes, ratio) {
  const box = lensBox(state, ratio), divided = panes.length === 2, width = figure.clientWidth, beside = width >= BESIDE;
  const height = Math.max(LEAST, document.documentElement.clientHeight - at("controls").offsetHeight - AROUND);
  const groups = divided ? [panes] : panes.map((p) => [p]);
  const size = packed(groups.length, width - (state.lens && beside ? CROPS * width : 0), height, ratio);
  const canvases = tiles(stage, groups.map((group) => group.map((p) => p.label)), size, ratio);
  canvases.forEach((canvas, i) => {
    drawWhole(canvas, groups[i].map((p) => p.sheet), state.split);
    if (state.lens) drawBox(canvas, box);
  });
  at("split").style.width = `${size.wide}px`;
  crops.hidden = !state.lens;
  if (!state.lens) return;
  const names = shown().map((role) => [nameOf(role)]);
  const room = beside ? [width - stage.offsetWidth - BETWEEN, height] : [width, width * BELOW * Math.ceil(names.length / 2)];
  tiles(crops, names, packed(names.length, ...room, 1), 1).forEach((canvas, i) => drawCrop(canvas, panes[i].sheet, box));
}

// ------------------------------------------------------------------------------------------------------- the controls

function controls(chosen) { // show the state
  at("view").value = state.view;
  for (const radio of document.getElementsByName("scale")) radio.checked = radio.value === state.scale;
  for (const radio of document.getElementsByName("mode")) radio.checked = (radio.value === "error") === state.error;
  for (const box of document.getElementsByName("role")) {
    box.checked = chosen.includes(box.value); box.disabled = !has(box.value);
  }
  at("split").value = 100 * state.split; at("split").hidden = chosen.length !== 2;
  at("lens").checked = state.lens; at("zoom").textContent = `${state.zoom}×`;
  at("error-scale").hidden = !state.error || !has(gallery.truth);
}

toggles("scales", "radio", "scale", gallery.scales);
toggles("roles", "checkbox", "role", order.filter((role) => gallery.shots.some(({images}) => role in images)), nameOf);
at("view").append(...gallery.views.map((view) => new Option(view, view)));

at("controls").addEventListener("change", ({target}) => {
  if (target.name === "role") {
    const others = state.shown.filter((role) => role !== target.value);
    change({shown: target.checked ? [...others, target.value] : others.length ? others : [target.value]});
  } else if (target.name === "mode") change({error: target.value === "error"});
  else if (target.id === "lens") change({lens: target.checked});
  else change({[target.name]: target.value});
});
at("weaker").addEventListener("click", () => change({lens: true, zoom: state.zoom / 2}));
at("stronger").addEventListener("click", () => change({lens: true, zoom: state.zoom * 2}));
at("split").addEventListener("input", ({target}) => change({split: target.value / 100}));

let grabbed = null; // what a press moves: "split" or "lens"
function grip(event) {
  if (shown().length === 2 && (!state.lens || atDivider(event, state))) return "split";
  return state.lens ? "lens" : null;
}
function move(event) {
  const {x, y} = place(event);
  if (grabbed === "split") change({split: x});
  if (grabbed === "lens") change({x, y});
}
stage.addEventListener("pointerdown", (event) => {
  if (event.target.tagName !== "CANVAS") return;
  grabbed = grip(event);
  event.target.setPointerCapture(event.pointerId);
  move(event);
});
stage.addEventListener("pointermove", (event) => {
  if (event.target.tagName !== "CANVAS") return;
  if (event.buttons & 1) move(event);
  else event.target.style.cursor = {split: "ew-resize", lens: "crosshair"}[grip(event)] || "default";
});
stage.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const changes = {...lensMoves(event, state), ...shortcuts(state)};
  if (!(event.key in changes)) return;
  change(changes[event.key]);
  event.preventDefault();
});

window.addEventListener("resize", render);
window.addEventListener("hashchange", fromAddress);
if (fromAddress()) at("viewer").scrollIntoView(); else render();
