"use strict";
(() => {
  const gallery = JSON.parse(document.getElementById("gallery").textContent);
  const at = (id) => document.getElementById(id);
  const canvas = at("canvas"), ink = canvas.getContext("2d"), figure = at("compare");
  const ERROR_FULL = 32; // levels of 255 at the end of the error scale
  const STOPS = [[0, 0, 4], [86, 16, 110], [187, 55, 84], [249, 140, 10], [252, 255, 164]];
  const state = {
    view: gallery.views[0], scale: gallery.scales[gallery.scales.length - 1], left: "", right: "",
    error: false, split: 0.5, lens: false, x: 0.5, y: 0.5, zoom: 4,
  };

  const nameOf = (role) => role === gallery.truth ? gallery.truthName : role;
  const shot = () => gallery.shots.find((s) => s.view === state.view && s.scale === state.scale);
  const decoded = new Map();

  function picture(uri) { // a promise of a canvas that holds the image
    if (!decoded.has(uri)) {
      decoded.set(uri, new Promise((done, failed) => {
        const image = new Image();
        image.onload = () => {
          const sheet = document.createElement("canvas");
          sheet.width = image.naturalWidth; sheet.height = image.naturalHeight;
          sheet.getContext("2d", {willReadFrequently: true}).drawImage(image, 0, 0);
          done(sheet);
        };
        image.onerror = () => failed(new Error("an image of the page does not decode"));
        image.src = uri;
      }));
    }
    return decoded.get(uri);
  }

  function heat(level) { // colour of an error in levels of 255
    const t = Math.min(1, level / ERROR_FULL) * (STOPS.length - 1), i = Math.min(STOPS.length - 2, Math.floor(t));
    return STOPS[i].map((a, c) => a + (STOPS[i + 1][c] - a) * (t - i));
  }
  const HEAT = Array.from({length: 256}, (_, level) => heat(level));

  const errors = new Map();
  async function errorMap(role, images) { // the worst channel's difference from the truth, at each pixel
    const key = images[role].uri;
    if (!errors.has(key)) {
      const [a, b] = await Promise.all([picture(key), picture(images[gallery.truth].uri)]);
      const [x, y] = [a, b].map((sheet) => sheet.getContext("2d").getImageData(0, 0, sheet.width, sheet.height));
      const map = document.createElement("canvas");
      map.width = a.width; map.height = a.height;
      const out = new ImageData(a.width, a.height);
      for (let i = 0; i < x.data.length; i += 4) {
        const worst = Math.max(...[0, 1, 2].map((c) => Math.abs(x.data[i + c] - y.data[i + c])));
        const colour = HEAT[worst];
        out.data[i] = colour[0]; out.data[i + 1] = colour[1]; out.data[i + 2] = colour[2]; out.data[i + 3] = 255;
      }
      map.getContext("2d").putImageData(out, 0, 0);
      errors.set(key, map);
    }
    return errors.get(key);
  }

  function tag(role, images) {
    const {score} = images[role];
    return nameOf(role) + (score && ` · ${score}`);
  }

  let turn = 0;
  async function show() { // decodes what is asked for, then draws
    const mine = ++turn, {images, width, height} = shot();
    const hasTruth = gallery.truth in images;
    const asError = state.error && hasTruth;
    const get = (role) => asError ? errorMap(role, images) : picture(images[role].uri);
    const sheets = await Promise.all([get(state.left), get(state.right)]);
    if (mine !== turn) return; // asked for something else meanwhile
    at("left-tag").textContent = tag(state.left, images);
    at("right-tag").textContent = tag(state.right, images);
    at("error-scale").hidden = !asError;
    canvas.setAttribute("aria-label",
      `${state.view} at scale ${state.scale}, ${width} by ${height} pixels: ${nameOf(state.left)} left, ${nameOf(state.right)} right`);
    draw.sheets = sheets;
    draw();
  }

  function draw() {
    if (!draw.sheets) return;
    const [left, right] = draw.sheets;
    const wide = canvas.clientWidth, high = wide * left.height / left.width, density = window.devicePixelRatio || 1;
    canvas.width = Math.round(wide * density); canvas.height = Math.round(high * density);
    const w = canvas.width, h = canvas.height, cut = Math.round(state.split * w);
    ink.imageSmoothingEnabled = w < left.width; // pixels stay visible where there are few
    ink.imageSmoothingQuality = "high";
    for (const [sheet, from, to] of [[left, 0, cut], [right, cut, w]]) {
      if (to <= from) continue;
      ink.save(); ink.beginPath(); ink.rect(from, 0, to - from, h); ink.clip();
      ink.drawImage(sheet, 0, 0, w, h); ink.restore();
    }
    ink.fillStyle = "#fff"; ink.fillRect(cut - density, 0, 2 * density, h);
    ink.fillStyle = "rgb(15 18 22 / .55)"; ink.fillRect(cut - 2 * density, 0, density, h); ink.fillRect(cut + density, 0, density, h);
    if (state.lens) drawLens(left, right, w, h, density);
    figure.dataset.split = state.split.toFixed(3);
    figure.dataset.lens = state.lens ? `${state.x.toFixed(3)},${state.y.toFixed(3)},${state.zoom}` : "off";
    figure.dataset.shown = `${state.view}|${state.scale}|${state.left}|${state.right}|${state.error ? "error" : "image"}`;
  }

  function drawLens(left, right, w, h, density) { // the same pixels of both images, side by side
    const side = Math.min(190 * density, w * 0.42, h * 0.6), gap = 3 * density;
    const pixels = side / (state.zoom * density), scaled = pixels / (w / density) * left.width;
    const cx = state.x * left.width, cy = state.y * left.height;
    const x = Math.min(w - 2 * side - 3 * gap, Math.max(0, state.x * w - side)), above = state.y * h - side - 24 * density;
    const y = above >= 0 ? above : Math.min(h - side - 2 * gap, state.y * h + 24 * density);
    ink.save();
    ink.shadowColor = "rgb(0 0 0 / .45)"; ink.shadowBlur = 14 * density;
    ink.fillStyle = "#fff"; ink.fillRect(x, y, 2 * side + 3 * gap, side + 2 * gap);
    ink.restore();
    ink.imageSmoothingEnabled = false;
    [left, right].forEach((sheet, i) => {
      const px = x + gap + i * (side + gap), py = y + gap;
      ink.fillStyle = "#888"; ink.fillRect(px, py, side, side);
      ink.save(); ink.beginPath(); ink.rect(px, py, side, side); ink.clip();
      ink.drawImage(sheet, cx - scaled / 2, cy - scaled / 2, scaled, scaled, px, py, side, side);
      ink.restore();
    });
    const box = scaled / left.width * w;
    ink.lineWidth = 1.5 * density;
    for (const [colour, grow] of [["#000", 1.5 * density], ["#fff", 0]]) {
      ink.strokeStyle = colour;
      ink.strokeRect(state.x * w - box / 2 - grow, state.y * h - box / 2 - grow, box + 2 * grow, box + 2 * grow);
    }
  }

  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
  function split(value) { state.split = clamp(value, 0, 1); at("split").value = 100 * state.split; draw(); }
  function lens(x, y) { state.x = clamp(x, 0, 1); state.y = clamp(y, 0, 1); draw(); }
  function toggle(on) { state.lens = on; at("lens").checked = on; draw(); }
  function zoom(factor) { state.zoom = clamp(state.zoom * factor, 2, 32); at("zoom").textContent = `${state.zoom}×`; draw(); }

  function place(event) {
    const box = canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }
  canvas.addEventListener("pointerdown", (event) => {
    const [x, y] = place(event);
    if (state.lens && event.pointerType === "touch") lens(x, y); else split(x);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const [x, y] = place(event), touch = event.pointerType === "touch";
    if (event.buttons & 1 && !(touch && state.lens)) split(x);
    if (state.lens) lens(x, y);
  });
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 0.05 : 0.01;
    const moves = {
      ArrowLeft: () => lens(state.x - step, state.y), ArrowRight: () => lens(state.x + step, state.y),
      ArrowUp: () => lens(state.x, state.y - step), ArrowDown: () => lens(state.x, state.y + step),
      l: () => toggle(!state.lens), L: () => toggle(!state.lens), Escape: () => toggle(false),
      "+": () => zoom(2), "=": () => zoom(2), "-": () => zoom(0.5),
      "[": () => split(state.split - 0.02), "]": () => split(state.split + 0.02),
    };
    if (!(event.key in moves)) return;
    if (event.key.startsWith("Arrow") && !state.lens) toggle(true);
    moves[event.key]();
    event.preventDefault();
  });
  at("split").addEventListener("input", (event) => split(event.target.value / 100));
  at("lens").addEventListener("change", (event) => toggle(event.target.checked));
  at("weaker").addEventListener("click", () => zoom(0.5));
  at("stronger").addEventListener("click", () => zoom(2));

  function option(value, text) {
    const item = document.createElement("option");
    item.value = value; item.textContent = text;
    return item;
  }
  function roles() { // what both sides can show at this scale
    const {images} = shot(), has = Object.keys(images);
    const order = [gallery.truth, gallery.ceiling, ...gallery.recipes].filter((role, i, all) => has.includes(role) && all.indexOf(role) === i);
    for (const side of ["left", "right"]) {
      if (!has.includes(state[side])) state[side] = "";
      at(side).replaceChildren(...order.map((role) => option(role, nameOf(role))));
    }
    const first = gallery.recipes.find((role) => role !== gallery.ceiling);
    const best = has.includes("auto") ? "auto" : gallery.recipes[gallery.recipes.length - 1];
    state.left = state.left || (has.includes("classic") ? "classic" : first);
    state.right = state.right || best;
    at("left").value = state.left; at("right").value = state.right;
  }
  gallery.views.forEach((view) => at("view").append(option(view, view)));
  gallery.scales.forEach((scale) => {
    const label = document.createElement("label"), radio = document.createElement("input"), text = document.createElement("span");
    radio.type = "radio"; radio.name = "scale"; radio.value = scale; radio.checked = scale === state.scale;
    radio.addEventListener("change", () => { state.scale = scale; roles(); show(); });
    text.textContent = scale; label.append(radio, text); at("scales").append(label);
  });
  at("view").addEventListener("change", (event) => { state.view = event.target.value; roles(); show(); });
  for (const side of ["left", "right"]) at(side).addEventListener("change", (event) => { state[side] = event.target.value; show(); });
  document.getElementsByName("mode").forEach((radio) => radio.addEventListener("change", () => {
    state.error = radio.value === "error" && radio.checked; show();
  }));
  new ResizeObserver(draw).observe(canvas.parentElement);
  roles();
  show();
})();
