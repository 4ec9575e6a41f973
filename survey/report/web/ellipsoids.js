// Places and ellipsoids from the numbers that say them.

const CIRCLE = Array.from({ length: 33 }, (_, k) => [Math.cos((k * Math.PI) / 16), Math.sin((k * Math.PI) / 16)]);
const PLANES = [[0, 1], [0, 2], [1, 2]];

/** Where a pose (3x4 by rows) is. @param {number[]} pose @returns {number[]} */
export const eyeOf = (pose) => [pose[3], pose[7], pose[11]];

/** Nine numbers by rows. @param {number[]} c @returns {number[][]} */
export const matrix = (c) => [c.slice(0, 3), c.slice(3, 6), c.slice(6, 9)];

/** The three sections of an ellipsoid by its main planes, each a line. @param {number[]} x @param {number[][]} cov @param {number} factor of its half axes */
export function sections(x, cov, factor) {
  const axes = axesOf(cov);
  return PLANES.map(([a, b]) => CIRCLE.map(([c, s]) => x.map((y, k) => y + factor * (c * axes[a][k] + s * axes[b][k]))));
}

/** Principal axes (one sigma, m) of a covariance (3, 3): Jacobi's rotations. @param {number[][]} cov @returns {number[][]} */
function axesOf(cov) {
  const a = cov.map((row) => row.slice()), v = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < 12; sweep++) for (const [p, q] of PLANES) {
    if (Math.abs(a[p][q]) <= 1e-30) continue;
    const theta = 0.5 * Math.atan2(2 * a[p][q], a[q][q] - a[p][p]), c = Math.cos(theta), s = Math.sin(theta);
    for (let k = 0; k < 3; k++) { const [x, y] = [a[k][p], a[k][q]]; a[k][p] = c * x - s * y; a[k][q] = s * x + c * y; }
    for (let k = 0; k < 3; k++) { const [x, y] = [a[p][k], a[q][k]]; a[p][k] = c * x - s * y; a[q][k] = s * x + c * y; }
    for (let k = 0; k < 3; k++) { const [x, y] = [v[k][p], v[k][q]]; v[k][p] = c * x - s * y; v[k][q] = s * x + c * y; }
  }
  return [0, 1, 2].map((k) => [0, 1, 2].map((j) => v[j][k] * Math.sqrt(Math.max(0, a[k][k]))));
}
