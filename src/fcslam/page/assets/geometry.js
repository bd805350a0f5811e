// Poses [x, y, heading] and points [x, y], in metres and radians; and archives.

export const turned = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));
export function compose([x, y, a], [u, v, b]) {
  const c = Math.cos(a), s = Math.sin(a);
  return [x + c * u - s * v, y + s * u + c * v, turned(a + b)];
}
export const movedPoint = (pose, [u, v]) => compose(pose, [u, v, 0]).slice(0, 2); // a point
export function between([x, y, a], [u, v, b]) { // the second pose in the first
  const c = Math.cos(a), s = Math.sin(a);
  return [c * (u - x) + s * (v - y), c * (v - y) - s * (u - x), turned(b - a)];
}
export const distance = (p, q) => Math.hypot(p[0] - q[0], p[1] - q[1]);
export const length = (points) => points.reduce((sum, p, k) => sum + (k ? distance(p, points[k - 1]) : 0), 0);
export const area = (points) => Math.abs(points.reduce((sum, [x, y], k) => { const [u, v] = points[(k + 1) % points.length]; return sum + x * v - y * u; }, 0)) / 2;
export const middle = (points) => [0, 1].map((k) => points.reduce((sum, p) => sum + p[k], 0) / points.length);

// The direction of most walls of pictures, up to an eighth of a turn: edges along it and across it count the same.
export function wallDirection(images) {
  let sin = 0, cos = 0;
  for (const { data, width, height } of images)
    for (let y = 1; y < height - 1; y++)
      for (let x = 1; x < width - 1; x++) {
        const k = 4 * (y * width + x), at = (i, j) => data[k + 4 * (i + j * width)];
        const dx = at(1, -1) + 2 * at(1, 0) + at(1, 1) - at(-1, -1) - 2 * at(-1, 0) - at(-1, 1), dy = at(-1, -1) + 2 * at(0, -1) + at(1, -1) - at(-1, 1) - 2 * at(0, 1) - at(1, 1);
        const strength = Math.hypot(dx, dy); // Sobel
        if (strength < 150) continue;
        const angle = 4 * Math.atan2(dy, dx);
        sin += strength * Math.sin(angle); cos += strength * Math.cos(angle);
      }
  return Math.atan2(sin, cos) / 4;
}

function crc32(bytes) {
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let k = 0; k < 8; k++) crc = (crc >>> 1) ^ (0xedb88320 & -(crc & 1));
  }
  return ~crc >>> 0;
}

// A ZIP archive of files [name, bytes], which are stored as they are (APPNOTE.TXT 4.3).
export function zip(files) {
  const parts = [], directory = [];
  let offset = 0;
  const record = (numbers) => { const made = new DataView(new ArrayBuffer(numbers.reduce((sum, [size]) => sum + size, 0))); let at = 0; for (const [size, value] of numbers) { made[size === 2 ? "setUint16" : "setUint32"](at, value, true); at += size; } return new Uint8Array(made.buffer); };
  for (const [name, bytes] of files) {
    const path = new TextEncoder().encode(name), sizes = [[4, crc32(bytes)], [4, bytes.length], [4, bytes.length], [2, path.length], [2, 0]];
    const common = [[2, 20], [2, 0x800], [2, 0], [2, 0], [2, 0x21], ...sizes];
    const header = record([[4, 0x04034b50], ...common]);
    parts.push(header, path, bytes);
    directory.push(record([[4, 0x02014b50], [2, 20], ...common, [2, 0], [2, 0], [2, 0], [4, 0], [4, offset]]), path);
    offset += header.length + path.length + bytes.length;
  }
  const size = directory.reduce((sum, part) => sum + part.length, 0);
  return new Blob([...parts, ...directory, record([[4, 0x06054b50], [2, 0], [2, 0], [2, files.length], [2, files.length], [4, size], [4, offset], [2, 0]])], { type: "application/zip" });
}
