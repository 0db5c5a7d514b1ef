_legged_tasks() {
  local file
  for file in "$_legged_cfg"/*.yaml; do
    [ -e "$file" ] || continue
    file=${file##*/}
    printf '%s\n' "${file%.yaml}"
  done
}

# The tool that a command line is about: its words -> "legged.tools.train"; nothing for other programs.
_legged_tool() {
  local word after=
  for word in "$@"; do
    case "$word" in
      train.py | */train.py | legged-train) echo legged.tools.train; return ;;
      play.py | */play.py | legged-play) echo legged.tools.play; return ;;
      legged.*) if [ "$after" = -m ]; then echo "$word"; fi; return ;;
      python* | */python* | -m) ;;
      *) return ;;
    esac
    after=$word
  done
}

# Lines that begin with $1, in front of which $2 is written.
_legged_matching() {
  local line
  while IFS= read -r line; do
    case "$line" in "$1"*) printf '%s\n' "$2$line" ;; esac
  done
}

# Keys that begin with $1, up to the next dot: sections first, then what is in them.
_legged_next_keys() {
  local key rest
  _legged_keys | while IFS= read -r key; do
    case "$key" in
      "$1"*)
        rest=${key#"$1"}
        case "$rest" in *.*) printf '%s\n' "$1${rest%%.*}." ;; *) printf '%s\n' "$key=" ;; esac
        ;;
    esac
  done | sort -u
}

_legged_expanded() {
  local line
  while IFS= read -r line; do
    if [ "$line" = @tasks ]; then _legged_tasks; else printf '%s\n' "$line"; fi
  done
}

# What can stand in place of the word $1, after the word $2: _legged_candidates CURRENT PREVIOUS TOOL.
_legged_candidates() {
  local found
  if [ -z "$3" ]; then
    if [ "$2" = -m ]; then _legged_modules | _legged_matching "$1" ""; fi
    return
  fi
  case "$1" in
    --*=*) _legged_values "$3 ${1%%=*}" | _legged_expanded | _legged_matching "${1#*=}" "${1%%=*}="; return ;;
  esac
  case "$2" in
    --*)
      found=$(_legged_values "$3 $2" | _legged_expanded)
      if [ -n "$found" ]; then printf '%s\n' "$found" | _legged_matching "$1" ""; return; fi
      ;;
  esac
  case "$1" in
    -*) _legged_flags "$3" | _legged_matching "$1" "" ;;
    *=*) _legged_choices "${1%%=*}" | _legged_matching "${1#*=}" "${1%%=*}=" ;;
    *)
      _legged_alone "$3" | while IFS= read -r found; do
        if [ "$found" = @keys ]; then _legged_next_keys "$1"; else _legged_tasks | _legged_matching "$1" ""; fi
      done
      ;;
  esac
}
