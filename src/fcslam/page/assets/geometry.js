// Poses [x, y, heading] and points [x, y], in metres and radians.

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
