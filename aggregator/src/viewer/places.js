// Coordinates for people: points of the model in the world and, if the model is georeferenced, on the earth.
//
// Start reading at describePoint. The formulas are those of shared/geo/src/ellipsoid.rs and site.rs.

/* exported describePoint, describeLine, describeArea, describeProfile, heightOf */

/** Semi-major axis, metres, and squared eccentricity of WGS 84. */
const WGS84_AXIS_M = 6378137;
const WGS84_E2 = 0.00669437999014131699614;

const radians = (degrees) => (degrees * Math.PI) / 180;

function ecefOf({ latitude_deg, longitude_deg, height_m }) {
  const [lat, lon] = [radians(latitude_deg), radians(longitude_deg)];
  const normal = WGS84_AXIS_M / Math.sqrt(1 - WGS84_E2 * Math.sin(lat) ** 2);
  const across = (normal + height_m) * Math.cos(lat);
  return [across * Math.cos(lon), across * Math.sin(lon), (normal * (1 - WGS84_E2) + height_m) * Math.sin(lat)];
}

/** Latitude and longitude, degrees, and height above the ellipsoid, metres, of a point `enu` about an origin. */
function geodeticOf(enu, origin) {
  const [lat0, lon0] = [radians(origin.latitude_deg), radians(origin.longitude_deg)];
  const [east, north, up] = [
    [-Math.sin(lon0), Math.cos(lon0), 0],
    [-Math.sin(lat0) * Math.cos(lon0), -Math.sin(lat0) * Math.sin(lon0), Math.cos(lat0)],
    [Math.cos(lat0) * Math.cos(lon0), Math.cos(lat0) * Math.sin(lon0), Math.sin(lat0)],
  ];
  const p = add(add(add(ecefOf(origin), east, enu[0]), north, enu[1]), up, enu[2]);
  const across = Math.hypot(p[0], p[1]);
  let lat = Math.atan2(p[2], across * (1 - WGS84_E2));
  let height = 0;
  // Converges to below a micrometre near the ground.
  for (let i = 0; i < 5; i++) {
    const normal = WGS84_AXIS_M / Math.sqrt(1 - WGS84_E2 * Math.sin(lat) ** 2);
    height = across * Math.cos(lat) + p[2] * Math.sin(lat) - WGS84_AXIS_M ** 2 / normal;
    lat = Math.atan2(p[2] + WGS84_E2 * normal * Math.sin(lat), across);
  }
  return { latitude_deg: (lat * 180) / Math.PI, longitude_deg: (Math.atan2(p[1], p[0]) * 180) / Math.PI, height_m: height };
}

/** One line on a point of the model. */
function describePoint(point, scene) {
  const world = add(scene.origin, point, scene.unit);
  const text = `x ${world[0].toFixed(2)}, y ${world[1].toFixed(2)}, z ${world[2].toFixed(2)}`;
  if (!scene.geo) return text;
  const { latitude_deg: lat, longitude_deg: lon, height_m } = geodeticOf(world, scene.geo);
  const side = (value, names) => `${Math.abs(value).toFixed(7)}° ${names[value < 0 ? 1 : 0]}`;
  return `${side(lat, 'NS')}, ${side(lon, 'EW')}, height ${height_m.toFixed(2)} m (east ${world[0].toFixed(2)} m, north ${world[1].toFixed(2)} m, up ${world[2].toFixed(2)} m)`;
}

/** One line on the distance along some points. */
function describeLine(points, up, scene) {
  const unit = scene.geo ? ' m' : ' world units';
  const between = (a, b) => add([0, 0, 0], add(b, a, -1), scene.unit);
  const lengths = points.slice(1).map((point, i) => Math.hypot(...between(points[i], point)));
  const length = lengths.reduce((sum, value) => sum + value, 0);
  const whole = between(points[0], points.at(-1));
  const rise = dot(whole, up);
  const straight = Math.hypot(...whole);
  const level = Math.sqrt(Math.max(0, straight ** 2 - rise ** 2));
  return `distance ${length.toFixed(2)}${unit}, level ${level.toFixed(2)}${unit}, height difference ${rise.toFixed(2)}${unit}`;
}

/** One line on the polygon with these corners: its area on the map (shoelace formula), and its perimeter on the map. */
function describeArea(points, walk, scene) {
  const unit = scene.geo ? ' m' : ' world units';
  if (points.length < 3) return 'Tap at least three corners.';
  const flat = points.map((point) => [walk.east, walk.north].map((axis) => dot(point, axis) * scene.unit));
  const pairs = flat.map((corner, i) => [corner, flat[(i + 1) % flat.length]]);
  const area = Math.abs(pairs.reduce((sum, [a, b]) => sum + a[0] * b[1] - a[1] * b[0], 0)) / 2;
  const perimeter = pairs.reduce((sum, [a, b]) => sum + Math.hypot(b[0] - a[0], b[1] - a[1]), 0);
  const square = scene.geo ? ' m²' : ' square world units';
  return `area on the map ${area.toFixed(2)}${square}, perimeter ${perimeter.toFixed(2)}${unit}`;
}

/** The height of a point of the model in the world. */
function heightOf(point, up, scene) {
  return dot(add(scene.origin, point, scene.unit), up);
}

/** One line on heights along a line; null where there is no surface. */
function describeProfile(heights, length, scene) {
  const known = heights.filter((height) => height !== null);
  const unit = scene.geo ? ' m' : ' world units';
  if (!known.length) return 'There is no surface along this line.';
  const [low, high] = [Math.min(...known), Math.max(...known)];
  return `profile over ${length.toFixed(2)}${unit}: heights ${low.toFixed(2)} to ${high.toFixed(2)}${unit}`;
}
