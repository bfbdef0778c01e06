"use strict";
// Outlines and names of the objects in the image. The names of objects and goals keep clear of each
// other and of the outlines.

function boxOf(points) {
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

function overlap(a, b) {
  const width = Math.min(a[2], b[2]) - Math.max(a[0], b[0]), height = Math.min(a[3], b[3]) - Math.max(a[1], b[1]);
  return width > 0 && height > 0 ? width * height : 0;
}

// Place each label below, above or beside its outline, where it covers the least.
// `items`: label (a text element), box (of its outline); `fixed`: further boxes to keep clear of.
function placeLabels(items, fixed) {
  const size = 14 * 1000 / ($("overlay").clientWidth || 1000), image = [0, 0, 1000, 1000 * Ghost.aspect];
  const placed = [];
  for (const { label, box } of items) {
    const [x0, y0, x1, y1] = box, cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
    label.setAttribute("font-size", size);
    const half = label.getComputedTextLength() / 2 + 0.2 * size;
    const spots = [[cx, y1 + 0.7 * size], [cx, y0 - 0.7 * size], [x1 + half + 0.3 * size, cy], [x0 - half - 0.3 * size, cy],
      [cx, y1 + 1.9 * size], [cx, y0 - 1.9 * size]];
    const area = 2.4 * half * size;
    const cost = ([x, y], number) => {
      const own = [x - half, y - 0.6 * size, x + half, y + 0.6 * size];
      const covered = placed.reduce((sum, other) => sum + 4 * overlap(own, other), 0)
        + items.reduce((sum, other) => sum + (other.label === label ? 0 : overlap(own, other.box)), 0)
        + fixed.reduce((sum, other) => sum + overlap(own, other), 0);
      const kept = Number(label.dataset.spot || 0) === number ? 0 : 0.1;  // a label does not jump without a reason
      return covered / area + 10 * (1 - overlap(own, image) / area) + 0.02 * number + kept;
    };
    const costs = spots.map(cost), best = costs.indexOf(Math.min(...costs)), [x, y] = spots[best];
    label.dataset.spot = best;
    label.setAttribute("x", x);
    label.setAttribute("y", y + 0.35 * size);
    placed.push([x - half, y - 0.6 * size, x + half, y + 0.6 * size]);
  }
}

class ObjectMarks {
  constructor(onChoose) {
    this.onChoose = onChoose;
    this.marks = new Map();
  }

  // `objects`: name, outline and centre in the image; `active`: the object that is being tapped.
  render(objects, active) {
    const seen = objects.filter((each) => each.outline);
    for (const [name, mark] of this.marks) {
      if (seen.some((each) => each.name === name)) continue;
      mark.group.remove();
      this.marks.delete(name);
    }
    for (const { name, outline } of seen) {
      const mark = this.marks.get(name) || this.make(name), points = outline.map(scaled);
      mark.group.setAttribute("class", name === active ? "mark active" : "mark");
      mark.outline.setAttribute("points", pointList(points));
      mark.box = boxOf(points);
    }
  }

  make(name) {
    const mark = { group: drawn("g", {}), outline: drawn("polygon", {}), label: drawn("text", {}, name) };
    mark.group.append(mark.outline, mark.label);
    mark.outline.addEventListener("click", () => this.onChoose(name));
    $("objects").append(mark.group);
    this.marks.set(name, mark);
    return mark;
  }
}
