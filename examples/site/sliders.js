// The gallery: two pictures become one with a divider between them and a lens over both.

const WIDEST = 640, TALLEST = 0.7; // CSS px, and share of the screen's height, of a picture

function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

async function slider(box) {
  const images = [...box.querySelectorAll("img")], names = images.map(({alt}) => alt);
  const sheets = await Promise.all(images.map(({src}) => picture(src)));
  const ratio = sheets[0].height / sheets[0].width;
  const state = {split: 0.5, lens: false, x: 0.5, y: 0.5, zoom: 4};
  const stage = element("div", {className: "stage", tabIndex: 0}), crops = element("div", {className: "crops"});
  const split = element("input", {type: "range", min: 0, max: 100, ariaLabel: "divider"});
  const lens = element("input", {type: "checkbox"});
  const controls = element("div", {className: "controls"}, split, element("label", {}, lens, " lens"));
  box.replaceChildren(stage, controls, crops);
  stage.setAttribute("role", "img");
  stage.setAttribute("aria-label", `${names[0]} left of the divider, ${names[1]} right of it`);

  function render() {
    const wide = Math.floor(Math.min(box.clientWidth, WIDEST, TALLEST * document.documentElement.clientHeight / ratio));
    const [canvas] = tiles(stage, [names], {columns: 1, wide}, ratio), part = lensBox(state, ratio);
    drawWhole(canvas, sheets, state.split);
    controls.style.width = `${wide}px`;
    split.value = 100 * state.split; lens.checked = state.lens; crops.hidden = !state.lens;
    box.dataset.split = state.split.toFixed(3);
    if (!state.lens) return;
    drawBox(canvas, part);
    const size = {columns: 2, wide: Math.floor((wide - GAP) / 2)};
    tiles(crops, names.map((name) => [name]), size, 1).forEach((crop, i) => drawCrop(crop, sheets[i], part));
  }
  function change(parts) {
    Object.assign(state, parts);
    bound(state);
    render();
  }
  let grabbed = null; // what a press moves
  function move(event) {
    const {x, y} = place(event);
    change(grabbed === "lens" ? {x, y} : {split: x});
  }
  stage.addEventListener("pointerdown", (event) => {
    if (event.target.tagName !== "CANVAS") return;
    grabbed = state.lens && !atDivider(event, state) ? "lens" : "split";
    event.target.setPointerCapture(event.pointerId);
    move(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (event.target.tagName === "CANVAS" && event.buttons & 1) move(event);
  });
  stage.addEventListener("keydown", (event) => {
    const changes = {...lensMoves(event, state), ...shortcuts(state)};
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in changes)) return;
    change(changes[event.key]);
    event.preventDefault();
    event.stopPropagation(); // the page's own keys
  });
  split.addEventListener("input", () => change({split: split.value / 100}));
  lens.addEventListener("change", () => change({lens: lens.checked}));
  window.addEventListener("resize", render);
  render();
}

for (const box of document.querySelectorAll(".compare")) slider(box);
