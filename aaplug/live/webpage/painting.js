// What is drawn over the picture: a value per pixel with its legend, the cameras, and the photograph.

const TWO_SIDED_COLOURS = [[178, 24, 43], [244, 165, 130], [247, 247, 247], [146, 197, 222], [33, 102, 172]]; // red, white, blue
const GROWING_COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const VALUE_LEVELS = 254; // from low to high; 0 says that there is no value
const OVERLAY_ALPHA = 190; // of 255: how far what is painted hides the picture
const PICK_RADIUS_PX = 18; // CSS px around a camera in which it is picked
const FRUSTUM_DEPTH = 0.04; // of the distance to the scene

const stopsOf = (legend) => legend.middle === null ? GROWING_COLOURS : TWO_SIDED_COLOURS;

function valueAt(legend, share) {
  const {low, high, log} = legend;
  return log ? low * (high / low) ** share : low + (high - low) * share;
}

const shortNumber = (value) => value >= 100 ? value.toFixed(0) : String(+value.toPrecision(3));

function paintSheet(bitmap, legend) { // a sheet of colours, and the levels beneath
  const [sheet, ink] = sheetOf(bitmap.width, bitmap.height);
  ink.drawImage(bitmap, 0, 0);
  const image = ink.getImageData(0, 0, sheet.width, sheet.height), levels = new Uint8Array(sheet.width * sheet.height);
  const colours = Array.from({length: VALUE_LEVELS + 1}, (_, i) => ramp(stopsOf(legend), i / VALUE_LEVELS));
  for (let i = 0; i < levels.length; i++) {
    const level = levels[i] = image.data[4 * i];
    if (level) image.data.set([...colours[level - 1], OVERLAY_ALPHA], 4 * i);
    else image.data[4 * i + 3] = 0;
  }
  ink.putImageData(image, 0, 0);
  return {sheet, levels, legend};
}

function valueUnder({sheet, levels, legend}, x, y) { // under a place in shares, as text
  const column = Math.min(sheet.width - 1, Math.floor(x * sheet.width)), row = Math.min(sheet.height - 1, Math.floor(y * sheet.height));
  const level = levels[row * sheet.width + column];
  return level ? String(+valueAt(legend, (level - 1) / VALUE_LEVELS).toPrecision(2)) : "nothing"; // levels tell no more digits
}

function drawLegend(place, legend) {
  place.querySelector("b").textContent = legend.title;
  place.querySelector("small").textContent = legend.about;
  const ink = place.querySelector("canvas").getContext("2d");
  for (let i = 0; i < 256; i++) {
    ink.fillStyle = `rgb(${ramp(stopsOf(legend), i / 255)})`;
    ink.fillRect(i, 0, 1, 1);
  }
  place.querySelectorAll("div span").forEach((span, i) => { span.textContent = shortNumber(valueAt(legend, i / 2)); });
}

function camerasIn(views, pose, focal, size, depth) { // the cameras of the data set as lines, in shares of the picture
  const place = (point) => {
    const at = projected(point, pose, focal);
    return at && [0.5 + at[0] / size[0], 0.5 + at[1] / size[1]];
  };
  return views.map((view, index) => ({index, name: view.name, points: frustum(view, FRUSTUM_DEPTH * depth).map(place)}))
    .filter(({points}) => points.every((p) => p && Math.abs(p[0] - 0.5) < 1 && Math.abs(p[1] - 0.5) < 1));
}

function drawCameras(canvas, cameras, hovered) {
  const ink = canvas.getContext("2d"), density = window.devicePixelRatio || 1;
  for (const {index, name, points} of cameras) {
    const [eye, ...corners] = points.map(([x, y]) => [x * canvas.width, y * canvas.height]);
    ink.beginPath();
    corners.forEach((corner, i) => { ink.moveTo(...eye); ink.lineTo(...corner); ink.lineTo(...corners[(i + 1) % 4]); });
    for (const [colour, width] of [["rgb(15 18 22 / .35)", 2.5], [index === hovered ? "#ffb02e" : "#fff", index === hovered ? 2 : 1]]) {
      ink.strokeStyle = colour; ink.lineWidth = width * density; ink.stroke();
    }
    if (index !== hovered) continue;
    ink.font = `${13 * density}px system-ui`; ink.lineWidth = 3 * density; ink.strokeStyle = "rgb(15 18 22 / .8)"; ink.fillStyle = "#fff";
    ink.strokeText(name, eye[0] + 8 * density, eye[1]); ink.fillText(name, eye[0] + 8 * density, eye[1]);
  }
}

function cameraNear(cameras, x, y, box) { // the one whose eye is nearest to a place in shares
  const far = ({points: [eye]}) => Math.hypot((eye[0] - x) * box.width, (eye[1] - y) * box.height);
  const near = cameras.filter((one) => far(one) < PICK_RADIUS_PX).sort((a, b) => far(a) - far(b));
  return near.length ? near[0].index : null;
}
