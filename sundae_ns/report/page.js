"use strict";
// Sliders, layers, order and size of the views. Without it, the images of a view stand one below the other.
for (const card of document.querySelectorAll(".view")) {
  const stage = card.querySelector(".stage");
  const slider = card.querySelector("input[type=range]");
  const [left, right] = ["left", "right"].map((side) => card.querySelector(`.tag.${side}`));
  const under = card.querySelector(".under");
  const truth = { src: under.src, alt: under.alt, name: left.textContent };

  const show = () => {
    stage.style.setProperty("--at", `${slider.value}%`);
    slider.setAttribute("aria-valuetext", `${slider.value}% ${left.textContent}, the rest ${right.textContent}`);
  };
  const layer = () => {
    const chosen = card.querySelector(".layers input:checked").value;
    for (const image of card.querySelectorAll(".over")) image.hidden = image.dataset.layer !== chosen;
    right.textContent = chosen;
    show();
  };
  const follow = (event) => {
    const box = stage.getBoundingClientRect();
    slider.value = Math.round((100 * (event.clientX - box.left)) / box.width);
    show();
  };
  // On the whole image: some browsers move a slider only by its thumb. A finger that scrolls the page moves nothing.
  let start = null;
  stage.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !event.isPrimary) return;
    start = event.pointerType === "touch" ? event : null;
    if (!start) {
      event.preventDefault();
      follow(event);
    }
    stage.setPointerCapture(event.pointerId);
    slider.focus({ preventScroll: true });
  });
  stage.addEventListener("pointermove", (event) => {
    if (!stage.hasPointerCapture(event.pointerId)) return;
    if (start && Math.abs(event.clientX - start.clientX) <= Math.abs(event.clientY - start.clientY)) return;
    start = null;
    follow(event);
  });
  stage.addEventListener("click", (event) => {
    if (event.isTrusted && event.detail) follow(event);
  });
  slider.addEventListener("input", show);
  card.querySelector(".layers").addEventListener("change", layer);
  card.querySelector(".beside")?.addEventListener("change", (event) => {
    const other = document.getElementById(event.target.value)?.querySelector('[data-layer="rendering"]');
    under.src = other ? other.src : truth.src;
    under.alt = other ? other.alt : truth.alt;
    left.textContent = other ? event.target.selectedOptions[0].textContent : truth.name;
    show();
  });
  const larger = card.querySelector(".larger");
  larger.addEventListener("click", () => {
    const on = card.classList.toggle("wide");
    larger.setAttribute("aria-pressed", on);
    card.scrollIntoView({ block: "nearest" });
  });
  layer();
}

for (const run of document.querySelectorAll(".run")) {
  const views = run.querySelector(".views");
  const order = run.querySelector(".order");
  const quality = (card) => Number(card.dataset.psnr.replace("inf", "Infinity").replace("nan", "-Infinity"));
  const orders = {
    worst: (a, b) => quality(a) - quality(b),
    best: (a, b) => quality(b) - quality(a),
    name: (a, b) => a.dataset.name.localeCompare(b.dataset.name, undefined, { numeric: true }),
    capture: (a, b) => a.dataset.index - b.dataset.index,
  };
  const sort = () => views.append(...[...views.children].sort(orders[order.value]));
  order?.addEventListener("change", sort);
  run.querySelector(".all")?.addEventListener("change", (event) => {
    for (const one of run.querySelectorAll(".layers input")) {
      if (one.value === event.target.value && !one.checked) {
        one.checked = true;
        one.dispatchEvent(new Event("change", { bubbles: true }));
      }
    }
  });
  if (order) sort();
}
document.documentElement.classList.add("ready");
