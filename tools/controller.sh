# controller.sh: sourced by tools/demo. Tells with which controller a daemon scores.
#
#   default_controller MORPHOCTL ADDRESS FILE           prints "NAME SHA256" of the controller `default`. NAME: that of FILE if it is in it, else
#                                                       another name of it, if it has one
#   tell_controller MORPHOCTL ADDRESS FILE NAME SHA256  tells name and hash, and how FILE becomes the default where it is not

default_controller() {
  "$1" controller list --server "$2" --json | /usr/bin/python3 -c '
import hashlib, json, pathlib, sys
file = pathlib.Path(sys.argv[1])
names = {one["name"]: one["sha256"] for one in json.load(sys.stdin)["items"]}
sha256 = names["default"]
shipped = hashlib.sha256(file.read_bytes()).hexdigest() == sha256
others = [name for name in names if name != "default" and names[name] == sha256]
print(file.stem if shipped else others[0] if others else "default", sha256)' "$3"
}

tell_controller() {
  local morphoctl=$1 address=$2 file=$3 name=$4 sha256=$5 shipped
  shipped=$(sha256sum <"$file")
  echo "Controller: $name, sha256 ${sha256:0:16}…, the default of this daemon."
  [ "$sha256" = "${shipped%% *}" ] ||
    printf 'It is not the shipped one, %s, which becomes the default by: %q controller put --server %q default %q\n' \
      "$(basename "$file" .safetensors)" "$morphoctl" "$address" "$file"
}
