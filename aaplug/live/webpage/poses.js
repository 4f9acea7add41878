// Poses: a camera as `pose`, its cam_from_world row by row, and `depth`, the distance to the point that it turns about.
// Rows of the rotation are the camera's right, down and forward in the world.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, by = 1) => a.map((x, i) => x + by * b[i]);
const axesOf = (pose) => [pose.slice(0, 3), pose.slice(4, 7), pose.slice(8, 11)];
const MAX_POLE_COSINE = 0.995; // of the cosine between sight and up: beyond it a turn would roll over

function eyeOf(pose) {
  const shift = [pose[3], pose[7], pose[11]], axes = axesOf(pose);
  return [0, 1, 2].map((i) => -axes.reduce((sum, axis, j) => sum + axis[i] * shift[j], 0));
}

const poseOf = (axes, eye) => [...axes.flatMap((axis) => [...axis, -dot(axis, eye)]), 0, 0, 0, 1];

function rotated(vector, axis, angle) { // Rodrigues' formula, for a unit axis
  const [x, y, z] = axis, [a, b, c] = vector, cos = Math.cos(angle), along = dot(axis, vector) * (1 - cos);
  const cross = [y * c - z * b, z * a - x * c, x * b - y * a];
  return vector.map((v, i) => v * cos + cross[i] * Math.sin(angle) + axis[i] * along);
}

function turned({pose, depth}, yaw, pitch, up) { // about the point in front, in radians
  const axes = axesOf(pose), eye = eyeOf(pose), pivot = plus(eye, axes[2], depth);
  const upright = Math.sign(-dot(axes[1], up)) || 1; // a camera that hangs upside down turns the other way
  const apart = Math.abs(dot(rotated(axes[2], axes[0], pitch), up));
  const tilt = apart > MAX_POLE_COSINE && apart > Math.abs(dot(axes[2], up)) ? 0 : pitch;
  const all = (v) => rotated(rotated(v, axes[0], tilt), up, yaw * upright);
  const [right, down, forward] = axes.map(all);
  return {pose: poseOf([right, down, forward], plus(pivot, forward, -depth)), depth};
}

function panned({pose, depth}, right, down) { // by shares of the depth
  const axes = axesOf(pose);
  return {pose: poseOf(axes, plus(plus(eyeOf(pose), axes[0], right * depth), axes[1], down * depth)), depth};
}

function dollied({pose, depth}, by) { // to `by` times the distance
  const axes = axesOf(pose), next = Math.min(1e6, Math.max(1e-6, depth * by));
  return {pose: poseOf(axes, plus(eyeOf(pose), axes[2], depth - next)), depth: next};
}

function looked(pose, yaw, pitch) { // turned on the spot, in radians
  const axes = axesOf(pose), [right, down] = axes;
  return poseOf(axes.map((v) => rotated(rotated(v, right, pitch), down, yaw)), eyeOf(pose));
}

function projected(point, pose, focal) { // x and y in px from the middle of the picture; null behind the camera
  const [x, y, z] = axesOf(pose).map((axis, i) => dot(axis, point) + pose[4 * i + 3]);
  return z > 1e-6 ? [x / z * focal, y / z * focal] : null;
}

function frustum({pose, width, height, focal}, depth) { // its eye, and the corners of its picture at a depth
  const axes = axesOf(pose), eye = eyeOf(pose), x = width / focal / 2 * depth, y = height / focal / 2 * depth;
  const corner = (sx, sy) => plus(plus(plus(eye, axes[2], depth), axes[0], sx * x), axes[1], sy * y);
  return [eye, corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
}

function worldFromCamera(pose) { // row by row, OpenGL axes, as camera_path.json has it
  const [right, down, forward] = axesOf(pose), eye = eyeOf(pose);
  return [...[0, 1, 2].flatMap((i) => [right[i], -down[i], -forward[i], eye[i]]), 0, 0, 0, 1];
}
