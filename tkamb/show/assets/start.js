const map = document.getElementById("figure-map");
if (map) insertMap(map, data.maps);
for (const figure of document.querySelectorAll("figure[id]")) addTools(figure);
slider.addEventListener("input", () => show(Number(slider.value)));
document.getElementById("bar").hidden = false;
document.body.classList.add("live");
show(Number(slider.value));
