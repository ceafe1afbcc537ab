#include <algorithm>

#include "view/links.h"
#include "world/world.h"

/// Which springs broke in a step or an edit, and by what.
namespace tensormass::world {

/// Takes the broken springs from the backend, in the order of the scene, and adds those that are new to newly_broken_.
void World::read_broken() {
  state_->read_broken(broken_);
  broken_count_ = 0;
  std::size_t attachment = 0, first = 0;  // the attachment of a spring, and its first spring
  for (std::size_t spring = 0; spring < broken_.size(); ++spring) {
    while (attachment < model_->attachments.size() &&
           spring == first + model_->attachments[attachment].springs.size()) {
      first += model_->attachments[attachment++].springs.size();
    }
    const std::uint8_t state = broken_[model_->links.spring_places[spring]];
    const auto bit = static_cast<std::uint8_t>(1u << spring % 8);
    std::uint8_t& bits = broken_bits_[spring / 8];
    if (state == view::kSpringWhole) {
      bits &= static_cast<std::uint8_t>(~bit);
      continue;
    }
    ++broken_count_;
    if ((bits & bit) == 0) {
      add_news(attachment < model_->attachments.size() ? static_cast<std::uint32_t>(attachment) : SceneEvent::kNone,
               state);
    }
    bits |= bit;
  }
}

/// Counts a spring that broke. state: view::LinksView::broken of it.
void World::add_news(std::uint32_t attachment, std::uint8_t state) {
  const bool severed = state >= view::kSpringSevered;
  const std::uint32_t tool = severed ? state - view::kSpringSevered : SceneEvent::kNone;
  const auto found = std::find_if(newly_broken_.begin(), newly_broken_.end(), [&](const BrokenSprings& one) {
    return one.attachment == attachment && one.tool == tool && one.severed == severed;
  });
  if (found != newly_broken_.end()) {
    ++found->count;
  } else {
    newly_broken_.push_back({attachment, tool, severed, 1});
  }
}

}  // namespace tensormass::world
