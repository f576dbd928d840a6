// Figures of class "live": show the parts of the values that the controls have.
for (const figure of document.querySelectorAll("figure.live")) {
  const { states, said } = JSON.parse(figure.dataset.live);
  const parts = figure.querySelector(".parts > svg").children;
  const panels = figure.querySelectorAll("svg.panel");
  const form = figure.querySelector("form");
  const controls = [...form.querySelectorAll("[data-count]")];
  form.hidden = false;
  form.addEventListener("submit", (event) => event.preventDefault());
  const show = () => {
    let state = 0;
    for (const control of controls) {
      state = state * control.dataset.count + Number(control.value);
      if (!control.dataset.names) continue;
      const name = JSON.parse(control.dataset.names)[control.value];
      control.nextElementSibling.textContent = name;
      control.setAttribute("aria-valuetext", name);
    }
    panels.forEach((panel, number) => panel.replaceChildren(
      ...states[state][number].map((part) => parts[part].cloneNode(true))));
    figure.querySelector(".says").textContent = said[state];
  };
  form.addEventListener("input", show);
  form.addEventListener("reset", () => setTimeout(show));  // the controls have their first values then
}
