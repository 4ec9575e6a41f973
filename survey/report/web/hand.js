// What a hand does on a canvas: turns the wheel, drags, parts two fingers, points, clicks, presses arrows.

const WHEEL = 0.0014; // of a factor, for each pixel that the wheel turns
const STILL = 5; // px that a click may move
const ARROWS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/**
 * @param {HTMLCanvasElement} canvas
 * @param {{nearer: (by: number, x: number, y: number) => void, drag: (dx: number, dy: number, event: PointerEvent) => void,
 *   arrow: (right: number, down: number) => void, point: (x: number, y: number) => void, leave: () => void,
 *   click: (event: PointerEvent) => void}} does
 * @param {boolean} [calm] in a page that scrolls: the bare wheel is the page's
 */
export function obey(canvas, does, calm = false) {
  const held = new Map();
  let moved = 0;
  canvas.addEventListener("wheel", (event) => {
    if (calm && !event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    does.nearer(Math.exp(-event.deltaY * WHEEL), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, event); moved = 0; });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) { does.point(event.offsetX, event.offsetY); return; }
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    moved += Math.abs(dx) + Math.abs(dy);
    if (held.size === 2) {
      const other = [...held.values()].find((e) => e.pointerId !== event.pointerId), span = (e) => Math.hypot(e.clientX - other.clientX, e.clientY - other.clientY);
      does.nearer(span(event) / Math.max(1, span(before)), other.offsetX, other.offsetY);
    } else does.drag(dx, dy, event);
    held.set(event.pointerId, event);
  });
  canvas.addEventListener("pointerup", (event) => { held.delete(event.pointerId); if (moved < STILL) does.click(event); });
  canvas.addEventListener("pointercancel", (event) => held.delete(event.pointerId));
  canvas.addEventListener("pointerleave", does.leave);
  canvas.addEventListener("keydown", (event) => {
    const arrow = ARROWS[event.key];
    if (arrow) { event.preventDefault(); does.arrow(arrow[0], arrow[1]); }
  });
}
