// Comparing two pictures: a divider between them and a lens over both, as a state, what keys do to it, and where one grabs.
// Of the state: split, the share of the width left of the divider; lens; x and y, its centre as shares; and its zoom.

const STRENGTHS = [2, 32]; // of the lens: it shows this share of the picture's shorter side
const GRIP = 14; // CSS px beside the divider where it is grabbed although a press means something else, too

function bound(state) {
  for (const share of ["split", "x", "y"]) state[share] = clamp(state[share], 0, 1);
  state.zoom = clamp(state.zoom, ...STRENGTHS);
}

const lensText = ({x, y, zoom}) => [x.toFixed(3), y.toFixed(3), zoom].join();

function lensBox({x, y, zoom}, ratio) { // the square that the lens shows, inside the picture, in shares of its width
  const side = Math.min(1, ratio) / zoom;
  return {x: clamp(x - side / 2, 0, 1 - side), y: clamp(y * ratio - side / 2, 0, ratio - side), side};
}

function place({target, clientX, clientY}) { // of a pointer, as shares of what it is over
  const box = target.getBoundingClientRect();
  return {x: (clientX - box.left) / box.width, y: (clientY - box.top) / box.height, width: box.width};
}

function atDivider(event, {split}) {
  const {x, width} = place(event);
  return Math.abs(x - split) * width < GRIP;
}

function shortcuts({lens, zoom, split}) { // what keys change
  return {
    l: {lens: !lens}, L: {lens: !lens}, Escape: {lens: false},
    "+": {lens: true, zoom: zoom * 2}, "=": {lens: true, zoom: zoom * 2}, "-": {lens: true, zoom: zoom / 2},
    "[": {split: split - 0.02}, "]": {split: split + 0.02},
  };
}

function lensMoves({shiftKey}, {x, y}) {
  const step = shiftKey ? 0.05 : 0.01;
  return {
    ArrowLeft: {lens: true, x: x - step}, ArrowRight: {lens: true, x: x + step},
    ArrowUp: {lens: true, y: y - step}, ArrowDown: {lens: true, y: y + step},
  };
}
