/**
 * Names of robots: two words computed from an id, such as "amber crawler". A name is easy to say
 * and to remember, but only the id identifies a design, because two designs may share a name.
 */

/** 256 words of each kind. A change would rename all robots. */
const ADJECTIVES = `
  agile alpine amber ample amused ancient arctic ardent autumn azure basalt bashful bold bouncy
  brave breezy bright brisk bronze bubbly bumpy busy buttery calm camphor candid careful chatty
  cheery chilly chrome cinder citrus clever cloudy cobalt copper coral cosmic cotton cozy
  crafty crimson crisp crystal cubic curious curly dainty dapper daring dawning deft dotted
  double dreamy drowsy dusky eager earnest eastern elder electric elegant epic fabled fearless
  feathered fern festive fiery flaxen fleet floral fluent fluffy foggy fond frank fresh frosty
  frugal fuzzy gallant garnet gentle giddy gilded ginger glad gleaming golden graceful grand
  granite grassy gritty happy hardy hazel hearty hollow honest humble hushed icy indigo iron
  ivory jade jaunty jazzy jolly jovial joyful jumbo juniper kind kinetic lacy lantern lavender
  lavish leafy lemon level lilac limber linen lively lofty lunar magenta magic maple marble
  mellow mighty mild minty modest molten mossy muted nautical neon nimble noble northern nutmeg
  oaken ochre olive onyx opal orbital orchid paisley pastel patient pearly pebbled pensive
  peppy perky placid playful plucky plush polite proud purple quartz quick quiet quilted quirky
  radiant rapid regal robust rocky rosy royal ruby rugged rustic saffron salty sandy sapphire
  satin scarlet serene shaded shiny silent silken silver simple sleepy slender smoky smooth
  snappy snowy solar solid sonic southern speckled spiced spry square stately steady striped
  sturdy sunny supple swift tawny teal tender thrifty tidal tidy topaz tranquil trusty tundra
  turquoise twilight upbeat urban valiant vast velvet verdant vermilion vibrant vintage violet
  vivid waltzing warm wavy western whimsical wise witty wooden woolly zany zesty zigzag
`.trim().split(/\s+/);
const NOUNS = `
  acorn acrobat albatross alder almond alpaca anchor antelope anvil apricot arrow aspen aster
  avocet badger balloon bamboo banjo barley barn basket beacon beetle bell birch biscuit bison
  blossom bobcat bonfire boulder bramble bridge broom buffalo button cactus camel canary candle
  canoe canyon caribou castle cedar cello chestnut chipmunk cicada clarinet clover comet
  compass condor cookie corgi cottage coyote crab crane crater crawler cricket crocus crow
  cypress daisy dancer dolphin dragon drifter drum dynamo eagle echo egret elk engine ermine
  falcon fennel ferret ferry fiddle finch firefly flamingo flute fountain fox galaxy galleon
  gannet garden gazelle gecko geyser giraffe glacier glider goblet gopher grotto grouse guitar
  gull hammock hamster harbor harp hawk hedgehog heron hiker hopper ibex iguana jaguar jasmine
  jigsaw jogger kayak kestrel kettle kite kiwi koala ladder ladybug lagoon lark laurel lemur
  lizard llama lobster lotus lynx macaw magnet magnolia magpie mallard manatee mandolin mango
  marmot marten meadow meerkat melon mermaid meteor mitten moose mosaic mulberry narwhal nebula
  nugget oasis obelisk ocelot octopus orca oriole osprey ostrich otter oyster paddle panda
  panther papaya parrot peach pelican penguin petal pheasant pinwheel planet pony poppy prairie
  prism puffin pumpkin puzzle python quail quokka rabbit raccoon ranger raven reindeer ribbon
  river robin rocket rooster sailor salmon scooter seahorse sequoia skater skylark sparrow
  sphinx spruce squirrel starling stork strider sunset swallow swan tapir teapot temple thicket
  thimble thistle tiger toboggan tortoise toucan tractor trolley trout trumpet tulip tunnel
  turbine turtle unicorn valley viola volcano voyager waffle wagon walker walnut walrus warbler
  whale willow windmill wombat wren yak zebra zephyr
`.trim().split(/\s+/);

/** Returns a number of 32 bits in which each digit of a text changes every bit: FNV-1a, mixed. */
function hashOf(text) {
  let hash = 0x811c9dc5;
  for (let i = 0; i < text.length; i++) {
    hash = Math.imul(hash ^ text.charCodeAt(i), 0x01000193);
  }
  hash = Math.imul(hash ^ (hash >>> 16), 0x85ebca6b);
  hash = Math.imul(hash ^ (hash >>> 13), 0xc2b2ae35);
  return (hash ^ (hash >>> 16)) >>> 0;
}

/**
 * Returns the name of a design. All orientations of a design have the same name.
 * @param {string} robot a robot (ID@K) or an id of 36 digits
 */
export function nameOf(robot) {
  const hash = hashOf(robot.slice(0, 36));
  return `${ADJECTIVES[hash & 255]} ${NOUNS[(hash >>> 8) & 255]}`;
}

/** Returns the first digits of a robot, and its orientation: "00e4402e…@7". */
export const shortOf = (robot) =>
  `${robot.slice(0, 36).replace(/0+$/, '').slice(0, 8)}…${robot.slice(36)}`;

/** Words for the lists of names, for tests. */
export const WORDS = Object.freeze({ adjectives: ADJECTIVES, nouns: NOUNS });
