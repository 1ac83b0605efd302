# controller.sh: sourced by tools/demo. Shows the controller that a daemon scores with.
#
#   default_controller MORPHOCTL ADDRESS FILE
#       prints "NAME SHA256" of the controller `default`. NAME is that of FILE if the daemon's
#       default has the same content, else another name of the default, if it has one
#   print_controller MORPHOCTL ADDRESS FILE NAME SHA256
#       prints name and hash, and the command that makes FILE the default where it is not

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

print_controller() {
  local morphoctl=$1 address=$2 file=$3 name=$4 sha256=$5 shipped
  shipped=$(sha256sum <"$file")
  echo "Controller: $name, sha256 ${sha256:0:16}…, the default of this daemon."
  [ "$sha256" = "${shipped%% *}" ] ||
    printf '%s, %s, which becomes the default by: %q controller put --server %q default %q\n' \
      "It is not the shipped one" "$(basename "$file" .safetensors)" "$morphoctl" "$address" "$file"
}
