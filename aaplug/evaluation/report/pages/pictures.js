// Pictures: decoded images and maps of their errors, how many fit into a box, and drawing them; and rows of choices.

const ERROR_FULL = 32; // levels of 255 at the end of the error scale
const HEAT_STOPS = [[0, 0, 4], [86, 16, 110], [187, 55, 84], [249, 140, 10], [252, 255, 164]];
const GAP = 10, LABEL = 26; // CSS px between tiles, and of a label's line

const at = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

function toggles(parent, type, name, values, text = String) { // a row of radio buttons or check boxes
  at(parent).replaceChildren(...values.map((value) => {
    const label = document.createElement("label"), input = document.createElement("input"), words = document.createElement("span");
    Object.assign(input, {type, name, value});
    words.textContent = text(value);
    label.append(input, words);
    return label;
  }));
}

function ramp(stops, share) { // the colour between evenly spaced ones
  const at = share * (stops.length - 1), i = Math.min(stops.length - 2, Math.floor(at));
  return stops[i].map((a, c) => Math.round(a + (stops[i + 1][c] - a) * (at - i)));
}
const HEAT = Array.from({length: 256}, (_, level) => ramp(HEAT_STOPS, Math.min(1, level / ERROR_FULL))); // of errors in levels of 255

function sheetOf(width, height) {
  const sheet = document.createElement("canvas");
  sheet.width = width; sheet.height = height;
  return [sheet, sheet.getContext("2d", {willReadFrequently: true})];
}

function once(make) { // remembers what `make` promised, by its argument
  const known = new Map();
  return (key) => {
    if (!known.has(key)) known.set(key, make(key));
    return known.get(key);
  };
}

const picture = once(async (uri) => { // a canvas that holds the image
  const image = new Image();
  image.src = uri;
  await image.decode();
  const [sheet, ink] = sheetOf(image.naturalWidth, image.naturalHeight);
  ink.drawImage(image, 0, 0);
  return sheet;
});

const errorsAgainst = once((truth) => once(async (uri) => { // the worst channel's difference at each pixel, and the largest of all
  const sheets = await Promise.all([picture(uri), picture(truth)]);
  const {width, height} = sheets[0];
  const [x, y] = sheets.map((sheet) => sheet.getContext("2d").getImageData(0, 0, width, height).data);
  const [map, ink] = sheetOf(width, height), out = new ImageData(width, height);
  let largest = 0;
  for (let i = 0; i < x.length; i += 4) {
    const worst = Math.max(...[0, 1, 2].map((c) => Math.abs(x[i + c] - y[i + c])));
    largest = Math.max(largest, worst);
    out.data.set([...HEAT[worst], 255], i);
  }
  ink.putImageData(out, 0, 0);
  return {map, largest};
}));

function packed(count, width, height, ratio) { // how wide `count` tiles can be in a box, and in how many columns
  const choices = Array.from({length: count}, (_, i) => {
    const columns = i + 1, rows = Math.ceil(count / columns);
    const wide = (width - GAP * i) / columns, high = height / rows - LABEL - GAP;
    return {columns, wide: Math.floor(Math.min(wide, high / ratio))};
  });
  return choices.reduce((best, choice) => choice.wide > best.wide ? choice : best);
}

function tiles(parent, labels, {columns, wide}, ratio) { // canvases of one size, each under its labels
  while (parent.children.length > labels.length) parent.lastChild.remove();
  while (parent.children.length < labels.length) {
    const tile = document.createElement("div"), line = document.createElement("div");
    tile.className = "tile"; line.className = "labels";
    tile.append(line, document.createElement("canvas"));
    parent.append(tile);
  }
  parent.style.gridTemplateColumns = `repeat(${columns}, ${wide}px)`;
  const density = window.devicePixelRatio || 1;
  return labels.map((texts, i) => {
    const [line, canvas] = parent.children[i].children;
    line.replaceChildren(...texts.map((text) => {
      const label = document.createElement("span");
      label.textContent = text;
      return label;
    }));
    canvas.style.width = `${wide}px`; canvas.style.height = `${wide * ratio}px`;
    canvas.width = Math.round(wide * density); canvas.height = Math.round(wide * ratio * density);
    return canvas;
  });
}

function drawWhole(canvas, sheets, split) { // one picture, or two divided at a share of the width
  const ink = canvas.getContext("2d"), {width, height} = canvas, cut = Math.round(split * width);
  const [left, right] = sheets.length > 1 ? [[0, cut], [cut, width]] : [[0, width]];
  ink.imageSmoothingEnabled = width < sheets[0].width; // pixels stay visible where there are few
  ink.imageSmoothingQuality = "high";
  [left, right].slice(0, sheets.length).forEach(([from, to], i) => {
    ink.save(); ink.beginPath(); ink.rect(from, 0, to - from, height); ink.clip();
    ink.drawImage(sheets[i], 0, 0, width, height); ink.restore();
  });
  if (sheets.length > 1) outlined(ink, (grow, line) => ink.fillRect(cut - line / 2 - grow, 0, line + 2 * grow, height));
}

function drawCrop(canvas, sheet, {x, y, side}) { // a square of the picture, its pixels sharp
  const ink = canvas.getContext("2d"), of = sheet.width;
  ink.imageSmoothingEnabled = false;
  ink.drawImage(sheet, x * of, y * of, side * of, side * of, 0, 0, canvas.width, canvas.height);
}

function drawBox(canvas, {x, y, side}) {
  const ink = canvas.getContext("2d"), of = canvas.width;
  outlined(ink, (grow, line) => {
    ink.lineWidth = line + 2 * grow;
    ink.strokeRect(x * of, y * of, side * of, side * of);
  });
}

function outlined(ink, stroke) { // in white within a dark edge, seen on any picture
  const density = window.devicePixelRatio || 1;
  for (const [colour, grow] of [["rgb(15 18 22 / .6)", density], ["#fff", 0]]) {
    ink.fillStyle = ink.strokeStyle = colour;
    stroke(grow, 2 * density);
  }
}
